"""From light to grey levels: each effect is as large as its setting says, and off is off.

A depth sensor's noise, steps, limits, shadows and holes are where its geometry puts them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from events import CameraInfo
from events.camera_info import response_light, srgb_light, vignette_map
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    add_free_camera,
    announcement,
    camera_info,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.development import DepthMeter, Development
from sims.cameras.optics import generator
from sims.cameras.spec import DepthSensor
from tests.sims.cameras.scenes import frames_of

Image = npt.NDArray[np.uint8]
LIGHT = srgb_light()
RADTAN = {"model": "plumb_bob", "coefficients": [-0.1, 0.01, 0.0, 0.0]}


def spec(width: int = 64, height: int = 48, **settings: Any) -> CameraSpec:
    table = {"name": "c", "width": width, "height": height, **settings}
    return msgspec.convert(table, CameraSpec, dec_hook=lambda t, v: t.parse(v))


def developed(
    images: list[Image], shutter: tuple[float, float] = (0.0, 1.0), **settings: Any
) -> Image:
    """Return what becomes of some moments at an exposure time and gain."""
    height, width = images[0].shape[:2]
    development = Development(spec(width, height, **settings))
    return development.develop(images, generator(1, "c", 7), *shutter)


def flat(level: int, size: int = 300) -> Image:
    return np.full((size, size, 3), level, np.uint8)


@given(
    arrays.arrays(
        np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 3]))
    )
)
def test_an_ideal_camera_changes_no_byte(image: Image) -> None:
    """Nor does one that exposes as long as its reference, nor moments that are all the same."""
    image = image[..., 0] if image.shape[2] == 1 else image
    assert developed([image]) is image
    np.testing.assert_array_equal(
        developed([image], (0.005, 1.0), exposure="5ms", reference_exposure="5ms"), image
    )
    np.testing.assert_array_equal(developed([image] * 3), image)


def test_moments_are_added_in_linear_light() -> None:
    """Half black and half white is not the grey level in the middle, but sRGB's 188."""
    assert (developed([flat(0), flat(255)]) == 188).all()


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0])
def test_exposure_and_gain_are_factors_on_the_light(factor: float) -> None:
    ramp = np.arange(256, dtype=np.uint8)[None].repeat(2, axis=0)
    settings: dict[str, Any] = {"exposure": "2ms", "reference_exposure": "2ms"}
    expected = np.rint(np.interp(LIGHT[ramp] * factor, LIGHT, np.arange(256)))
    np.testing.assert_array_equal(developed([ramp], (0.002 * factor, 1.0), **settings), expected)
    np.testing.assert_array_equal(developed([ramp], (0.002, factor), **settings), expected)
    np.testing.assert_array_equal(developed([ramp], (0.0, factor)), expected)


@pytest.mark.parametrize("grey", [True, False])
def test_a_vignette_darkens_as_announced(grey: bool) -> None:
    """In linear light, of every channel."""
    image = np.full((48, 64) if grey else (48, 64, 3), 200, np.uint8)
    result = developed([image], vignette=(-0.5, 0.1))
    light = LIGHT[200] * vignette_map(camera_info(spec()), (-0.5, 0.1))
    expected = np.interp(light if grey else light[..., None].repeat(3, 2), LIGHT, np.arange(256))
    np.testing.assert_allclose(result, expected, atol=0.6)


@pytest.mark.parametrize("level", [30, 128, 220])
@pytest.mark.parametrize("gain", [1.0, 4.0])
@pytest.mark.parametrize("full_well", [2000.0, 20_000.0])
def test_shot_noise_is_that_of_the_electrons(level: int, gain: float, full_well: float) -> None:
    """Variance = mean, in electrons: found back by undoing the response, quantisation apart."""
    factor = 1.0 / gain  # the same light, of a shorter exposure
    result = developed(
        [flat(level)],
        (0.001 * factor, gain),
        full_well=full_well,
        response="linear",
        exposure="1ms",
        reference_exposure="1ms",
    )
    electrons = result / 255.0 * full_well / gain
    expected = LIGHT[level] * full_well / gain
    step = full_well / gain / 255.0
    assert electrons.mean() == pytest.approx(expected, rel=0.01, abs=0.5 * step)
    clipped = expected + 4.0 * expected**0.5 > full_well / gain
    if expected**0.5 > 0.5 * step and not clipped:  # so that rounding is no more than a noise
        assert electrons.mean() == pytest.approx(expected, rel=0.01)
        assert electrons.var() == pytest.approx(expected + step**2 / 12, rel=0.04)
    else:
        assert level in {30, 220}


def test_announced_noise_is_the_one_at_middle_grey() -> None:
    """Shot noise and the other together."""
    settings = spec(noise=2.0, full_well=3000.0)
    announced = announcement(settings, source="d/c", prefix="d/", parent_frame_id="base_link")
    result = developed([flat(128)], noise=2.0, full_well=3000.0)
    assert announced.noise == pytest.approx(result.std(), rel=0.03)
    assert announced.noise > 2.5
    plain = announcement(spec(noise=2.0), source="d/c", prefix="", parent_frame_id="b")
    assert plain.noise == 2.0


def test_a_response_is_undone_by_what_is_announced(tmp_path: Path) -> None:
    """Of a file, and of names; 255 stays white."""
    file = tmp_path / "pcalib.txt"
    file.write_text(" ".join(f"{255 * (k / 255) ** 1.7:.9g}" for k in range(256)), "utf-8")
    ramp = np.arange(256, dtype=np.uint8)[None]
    for response in ("linear", "gamma", str(file)):
        result = developed([ramp], response=response)
        announced = announcement(
            spec(response=response), source="c", prefix="", parent_frame_id="b"
        )
        light = response_light(announced.response)
        levels = np.arange(256)
        np.testing.assert_array_equal(result[0], np.rint(np.interp(LIGHT, light, levels)))
        assert result[0, -1] == 255


def test_a_response_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for text in ("", "1 2 3", "a b"):
        file = tmp_path / "pcalib.txt"
        file.write_text(text, "utf-8")
        with pytest.raises(ValueError, match="response: expected srgb, linear, gamma or a file"):
            Development(spec(response=str(file)))
    with pytest.raises(ValueError, match=r"missing\.txt"):
        Development(spec(response="missing.txt"))


@pytest.mark.slow
@given(
    st.floats(0.01, 50.0),
    st.integers(0, 255),
    st.sampled_from(["srgb", "linear", "gamma"]),
    st.sampled_from([0.0, 500.0, 1e5]),
)
def test_more_light_is_never_darker(
    factor: float, level: int, response: str, full_well: float
) -> None:
    """Whatever is on; and white is the end."""
    image = np.array([[level, 255]], np.uint8)
    settings: dict[str, Any] = {"response": response, "full_well": full_well}
    less, more = (developed([image], (0.0, g), **settings) for g in (factor, factor))
    np.testing.assert_array_equal(less, more)  # the same arguments, the same bytes
    if full_well == 0.0:
        brighter = developed([image], (0.0, 2.0 * factor), **settings)
        assert (brighter >= less).all()
        if factor >= 1.0:
            assert less[0, 1] == 255


def test_the_meter_reads_the_mean_light() -> None:
    random = np.random.default_rng(1)
    image = random.integers(0, 256, (240, 320, 3), np.uint8)
    for response in ("srgb", "linear"):
        development = Development(spec(320, 240, response=response))
        light = response_light(
            () if response == "srgb" else tuple(np.linspace(0.0, 1.0, 256).tolist())
        )
        assert development.meter(image) == pytest.approx(light[image].mean(), rel=0.02)
        assert development.meter(flat(255)) == 1.0
        assert development.meter(image[..., 0]) > 0.0


def test_defocus_is_in_linear_light() -> None:
    """A white line that blurs keeps its light."""
    image = np.zeros((41, 41), np.uint8)
    image[:, 20] = 255
    result = developed([image], blur=2.0)
    assert LIGHT[result[20]].sum() == pytest.approx(1.0, rel=0.02)
    assert cv2.minMaxLoc(result)[1] > 60


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"vignette": (0.5,)}, "vignette: expected shares of light from 0 to 1"),
        ({"vignette": (-1.5,)}, "vignette: expected shares of light from 0 to 1"),
        ({"auto_exposure": {}}, "auto_exposure: expected a reference_exposure"),
        (
            {"auto_exposure": {}, "reference_exposure": "1ms", "gain": 2.0},
            "neither exposure nor gain",
        ),
        ({"lens": RADTAN, "depth_sensor": {}}, "depth_sensor: expected a camera without"),
        (
            {"lens": RADTAN, "undistorted": True, "vignette": (-0.1,)},
            "undistorted: expected no vignette",
        ),
        ({"reference_exposure": "1ms"}, "reference_exposure: expected an exposure"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        spec(**settings)


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
    depth = measured(wall(z), **PURE | {"disparity_noise": 0.1, "focal": focal})
    expected = z * z / ((focal or INFO.fx) * 0.075) * 0.1
    inside = depth[np.isfinite(depth)].astype(np.float64)
    assert len(inside) > 0.99 * depth.size
    assert inside.std() == pytest.approx(expected, rel=0.1)
    assert inside.mean() == pytest.approx(z, abs=0.3 * expected)


@pytest.mark.parametrize("z", [0.8, 2.0, 6.0])
def test_noise_and_steps_together(z: float) -> None:
    """Rounding adds a twelfth of the step's square: in disparity, where both are the same."""
    depth = measured(wall(z), **PURE | {"disparity_noise": 0.1, "disparity_step": 0.125})
    disparity = INFO.fx * 0.075 / depth[np.isfinite(depth)].astype(np.float64)
    np.testing.assert_allclose(disparity / 0.125, np.rint(disparity / 0.125), atol=1e-3)
    assert disparity.std() == pytest.approx((0.1**2 + 0.125**2 / 12) ** 0.5, rel=0.1)


def test_steps_grow_with_the_square_of_depth() -> None:
    """A slope has as many values as there are steps, z² / (f b) · step apart."""
    slope = np.linspace(1.5, 4.0, 240, dtype=np.float32)[:, None].repeat(320, axis=1)
    depths = np.unique(measured(slope, **PURE | {"disparity_step": 0.125}))
    depths = depths[np.isfinite(depths)].astype(np.float64)
    steps, middles = np.diff(depths), (depths[1:] + depths[:-1]) / 2
    np.testing.assert_allclose(steps, middles**2 / (INFO.fx * 0.075) * 0.125, rtol=0.02)


@pytest.mark.parametrize("model", ["structured_light", "stereo"])
@pytest.mark.parametrize(("near", "far"), [(1.0, 2.0), (0.6, 4.0)])
def test_what_is_near_throws_a_shadow_to_its_left(model: str, near: float, far: float) -> None:
    """As wide as the disparities differ; and a stereo camera loses the band at the left, too."""
    depth = wall(far)
    depth[:, 150:200] = near
    lost = np.isinf(measured(depth, **PURE | {"model": model, "max_slant": 90.0}))
    reach = INFO.fx * 0.075
    shadow = reach / near - reach / far
    np.testing.assert_allclose(lost[:, 100:150].sum(axis=1), shadow, atol=0.51)
    assert lost[:, 150 - int(shadow) + 1 : 150].all()
    assert not lost[:, 150:].any()
    band = reach / far if model == "stereo" else 0.0
    np.testing.assert_allclose(lost[:, :100].sum(axis=1), band, atol=0.51)


def test_edges_are_lost_on_both_sides() -> None:
    """A pixel each: the square of 3×3 straddles the edge."""
    depth = wall(4.0)
    depth[100:150, 100:200] = 1.0
    lost = np.isinf(measured(depth, **PURE))
    for row in (99, 100, 149, 150):
        assert lost[row, 120:180].all()
    assert lost[120, [199, 200]].all()
    assert not lost[98, 50:].any()
    assert not lost[102:148, 102:198].any()


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
    hit = np.isfinite(measured(depth, **settings))
    inner = np.zeros_like(hit)
    inner[2:-2, 2:-2] = True
    inner &= inverse > 0.02
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert hit[inner & (degrees < 59.5)].all()
    assert not hit[inner & (degrees > 60.5)].any()


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
    lost = np.isinf(meter.measure(wall(2.0), dim, generator(1, "c", 7)))
    np.testing.assert_array_equal(lost, dark)
    plain = np.isinf(measured(wall(2.0), colour, **settings | {"model": "stereo"}))
    assert plain[:, 110:190].all()
    assert not plain[:, 224:].any()


@pytest.mark.slow
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


def test_depth_settings_that_cannot_be_are_refused() -> None:
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
    depth = frames_of(renderer, 0, pose_to_qpos((0, 0, 0), (1, 0, 0, 0)), ("c",))["c"].depth
    renderer.close()
    assert depth is not None
    row = depth[60]
    lost = np.isinf(row[50:80]).sum()  # the wall left of the box in the middle, which is 24 wide
    assert lost == pytest.approx(80 * 0.2 / 2.0 - 80 * 0.2 / 4.0 + 1, abs=1.1)
    assert row[80] == pytest.approx(2.0, rel=1e-3)
    assert row[20] == pytest.approx(4.0, rel=1e-3)
    assert np.isinf(row[120:135]).all()  # the black box, at the right
