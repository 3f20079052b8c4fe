"""A depth sensor's noise, steps, limits, shadows and holes are where its geometry puts them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from events import CameraInfo
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    add_free_camera,
    announcement,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.depth_sensor import DepthMeter, DepthSensor
from sims.cameras.noise import generator

Depths = npt.NDArray[np.float32]
INFO = CameraInfo.from_fov(320, 240, np.pi / 2)
WHITE = np.full((240, 320, 3), 255, np.uint8)
PURE: dict[str, Any] = {
    "disparity_step": 0.0,
    "disparity_noise": 0.0,
    "min_brightness": 0.0,
    "min_contrast": 0.0,
}
"""Geometry alone."""


def measured(
    depth: Depths, colour: npt.NDArray[np.uint8] = WHITE, stamp: int = 7, **settings: Any
) -> Depths:
    meter = DepthMeter(DepthSensor(**settings), INFO)
    return meter.measure(depth, colour, generator(1, "c", stamp))


def wall(z: float) -> Depths:
    return np.full((240, 320), z, np.float32)


@pytest.mark.parametrize("z", [0.8, 2.0, 6.0])
@pytest.mark.parametrize("focal", [0.0, 580.0])
def test_noise_is_that_of_the_disparity(z: float, focal: float) -> None:
    """sigma_z = z² / (f b) sigma_d, within 10 %; without a bias."""
    found = measured(wall(z), **PURE | {"disparity_noise": 0.1, "focal": focal})
    expected = z * z / ((focal or INFO.fx) * 0.075) * 0.1
    inside = found[np.isfinite(found)].astype(np.float64)
    assert len(inside) > 0.99 * found.size
    assert inside.std() == pytest.approx(expected, rel=0.1)
    assert inside.mean() == pytest.approx(z, abs=0.3 * expected)


@pytest.mark.parametrize("z", [0.8, 2.0, 6.0])
def test_noise_and_steps_together(z: float) -> None:
    """Rounding adds a twelfth of the step's square: in disparity, where both are the same."""
    found = measured(wall(z), **PURE | {"disparity_noise": 0.1, "disparity_step": 0.125})
    disparity = INFO.fx * 0.075 / found[np.isfinite(found)].astype(np.float64)
    np.testing.assert_allclose(disparity / 0.125, np.rint(disparity / 0.125), atol=1e-3)
    assert disparity.std() == pytest.approx((0.1**2 + 0.125**2 / 12) ** 0.5, rel=0.1)


def test_steps_grow_with_the_square_of_depth() -> None:
    """A slope has as many values as there are steps, z² / (f b) · step apart."""
    slope = np.linspace(1.5, 4.0, 240, dtype=np.float32)[:, None].repeat(320, axis=1)
    found = np.unique(measured(slope, **PURE | {"disparity_step": 0.125}))
    found = found[np.isfinite(found)].astype(np.float64)
    steps, middles = np.diff(found), (found[1:] + found[:-1]) / 2
    np.testing.assert_allclose(steps, middles**2 / (INFO.fx * 0.075) * 0.125, rtol=0.02)


@pytest.mark.parametrize("model", ["structured_light", "stereo"])
@pytest.mark.parametrize(("near", "far"), [(1.0, 2.0), (0.6, 4.0)])
def test_what_is_near_throws_a_shadow_to_its_left(model: str, near: float, far: float) -> None:
    """As wide as the disparities differ; and a stereo camera loses the band at the left, too."""
    depth = wall(far)
    depth[:, 150:200] = near
    found = np.isinf(measured(depth, **PURE | {"model": model, "max_slant": 90.0}))
    reach = INFO.fx * 0.075
    shadow = reach / near - reach / far
    np.testing.assert_allclose(found[:, 100:150].sum(axis=1), shadow, atol=0.51)
    assert found[:, 150 - int(shadow) + 1 : 150].all()
    assert not found[:, 150:].any()
    band = reach / far if model == "stereo" else 0.0
    np.testing.assert_allclose(found[:, :100].sum(axis=1), band, atol=0.51)


def test_edges_are_lost_on_both_sides() -> None:
    """A pixel each: the square of 3×3 straddles the edge."""
    depth = wall(4.0)
    depth[100:150, 100:200] = 1.0
    found = np.isinf(measured(depth, **PURE))
    for row in (99, 100, 149, 150):
        assert found[row, 120:180].all()
    assert found[120, [199, 200]].all()
    assert not found[98, 50:].any()
    assert not found[102:148, 102:198].any()


@pytest.mark.parametrize("angle", [40.0, 60.0, 75.0])
def test_a_slanted_plane_is_lost_beyond_the_angle(angle: float) -> None:
    """The angle is that to each pixel's own ray."""
    slope = np.tan(np.radians(angle))
    u = (np.arange(320) - INFO.cx) / INFO.fx
    v = ((np.arange(240) - INFO.cy) / INFO.fy)[:, None]
    inverse = (1.0 + slope * v) / 2.0 + 0.0 * u  # z = 2 - slope·y
    depth = np.where(inverse > 0.0, 1.0 / np.maximum(inverse, 1e-9), np.inf).astype(np.float32)
    normal = np.array([0.0, slope, 1.0]) / np.hypot(slope, 1.0)
    rays = np.stack(np.broadcast_arrays(u, v, 1.0), axis=-1)
    cosine = (rays @ normal) / np.linalg.norm(rays, axis=-1)
    settings = PURE | {"max_slant": 60.0, "min_depth": 0.0, "max_depth": 1e4}
    found = np.isfinite(measured(depth, **settings))
    inner = np.zeros_like(found)
    inner[2:-2, 2:-2] = True
    inner &= inverse > 0.02
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert found[inner & (degrees < 59.5)].all()
    assert not found[inner & (degrees > 60.5)].any()


def test_dark_surfaces_are_lost_to_structured_light_and_plain_ones_to_stereo() -> None:
    colour = np.full((240, 320, 3), 128, np.uint8)
    colour[:, 100:200] = 8  # 0.24 % of white's light
    colour[:, 220:] = np.random.default_rng(1).integers(100, 156, (240, 100, 3))
    settings = PURE | {"min_brightness": 0.01, "min_contrast": 2.0, "max_slant": 90.0}
    dark = np.isinf(measured(wall(2.0), colour, **settings))
    assert dark[:, 100:200].all()
    assert not dark[:, :100].any()
    assert not dark[:, 200:].any()
    dim = (colour / 2).astype(np.uint8)  # the projector has a light of its own
    meter = DepthMeter(DepthSensor(**settings), INFO, light=0.5)
    found = np.isinf(meter.measure(wall(2.0), dim, generator(1, "c", 7)))
    np.testing.assert_array_equal(found, dark)
    plain = np.isinf(measured(wall(2.0), colour, **settings | {"model": "stereo"}))
    assert plain[:, 110:190].all()
    assert not plain[:, 224:].any()


@given(
    arrays.arrays(
        np.float32,
        (12, 16),
        elements=st.one_of(st.floats(0.03125, 500.0, width=32), st.just(float("inf"))),
    ),
    st.sampled_from(["structured_light", "stereo"]),
    st.floats(0.0, 2.0),
    st.just(0.0) | st.floats(0.001, 2.0),
    st.integers(0, 2**40),
)
def test_nothing_is_measured_out_of_range(
    depth: Depths, model: Any, noise: float, step: float, stamp: int
) -> None:
    """Whatever the scene, noise and steps: in the limits or none; the same again for the same."""
    info = CameraInfo.from_fov(16, 12, 1.5)
    sensor = DepthSensor(model=model, disparity_noise=noise, disparity_step=step)
    colour = np.random.default_rng(stamp).integers(0, 256, (12, 16, 3), np.uint8)
    before = depth.copy()
    first, second = (
        DepthMeter(sensor, info).measure(depth, colour, generator(1, "c", stamp)) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(depth, before)
    assert first.dtype == np.float32
    known = first[~np.isinf(first)]
    assert ((known >= sensor.min_depth) & (known <= sensor.max_depth)).all()
    assert np.isinf(first[np.isinf(depth)]).all() or noise > 0.0


def test_what_is_announced_is_what_is_measured() -> None:
    spec = CameraSpec(name="c", width=320, height=240, depth_sensor=DepthSensor(focal=580.0))
    announced = announcement(spec, source="d/c", prefix="d/", parent_frame_id="base_link")
    assert announced.depth_noise == pytest.approx(0.07 / (580 * 0.075))
    assert announced.depth_step == pytest.approx(0.125 / (580 * 0.075))
    assert (announced.min_depth, announced.max_depth) == (0.4, 10.0)


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="min_depth, max_depth: expected a range"):
        DepthSensor(min_depth=3.0, max_depth=2.0)
    with pytest.raises(ValueError, match="disparity_step: expected 0 or"):
        DepthSensor(disparity_step=1e-9)
    with pytest.raises(ValueError, match="depth_sensor: expected its own disparity_noise alone"):
        CameraSpec(name="c", depth_sensor=DepthSensor(), depth_noise=0.001)


@pytest.mark.parametrize("images", [("depth",), ("rgb", "depth")])
def test_a_rendered_box_throws_its_shadow(images: Any) -> None:
    """Through the renderer, whether or not colours are wanted; a black box is lost."""
    sensor = DepthSensor(disparity_noise=0.0, disparity_step=0.0, baseline=0.2)
    spec = CameraSpec(
        name="c", images=images, width=160, height=120, position=(0, 0, 0), depth_sensor=sensor
    )
    world = mujoco.MjSpec()
    world.visual.headlight.ambient = [0.8, 0.8, 0.8]
    for place, size, grey in (
        ([4.1, 0, 0], [0.1, 9, 9], 0.8),
        ([2.05, 0.0, 0], [0.05, 0.3, 0.4], 0.8),
        ([2.05, -1.2, 0], [0.05, 0.3, 0.4], 0.01),
    ):
        rgba = [grey, grey, grey, 1.0]
        world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=place, rgba=rgba)
    prefix = add_free_camera(world, "free", (spec,))
    renderer = CameraRenderer(model_to_bytes(world.compile()), (spec,), prefix, seed=0)
    depth = renderer.render(0, pose_to_qpos((0, 0, 0), (1, 0, 0, 0)), ("c",))["c"].depth
    renderer.close()
    assert depth is not None
    row = depth[60]
    lost = np.isinf(row[50:80]).sum()  # the wall left of the box in the middle, which is 24 wide
    assert lost == pytest.approx(80 * 0.2 / 2.0 - 80 * 0.2 / 4.0 + 1, abs=1.1)
    assert row[80] == pytest.approx(2.0, rel=1e-3)
    assert row[20] == pytest.approx(4.0, rel=1e-3)
    assert np.isinf(row[120:135]).all()  # the black box, at the right
