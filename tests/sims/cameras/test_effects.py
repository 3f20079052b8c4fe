"""What a camera's settings do to its images, and what they leave alone."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from events.camera_info import srgb_light
from events.frames import from_rpy
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    Frame,
    add_free_camera,
    camera_info,
    model_to_bytes,
    pose_to_qpos,
    qvel_between,
)
from sims.cameras.development import Development
from sims.cameras.noise import generator
from sims.cameras.response import moments

EXPOSURE = 0.02
PLAIN = CameraSpec(
    name="plain",
    images=("rgb", "depth", "segmentation"),
    width=96,
    height=64,
    position=(0.0, 0.0, 0.0),
)


def like_plain(name: str, **changes: object) -> CameraSpec:
    return msgspec.structs.replace(PLAIN, name=name, **changes)


CAMERAS = (
    PLAIN,
    like_plain("open", exposure=EXPOSURE),
    like_plain("open_grey", exposure=EXPOSURE, images=("grey",)),
    like_plain("open_depth", exposure=EXPOSURE, images=("depth",)),
    like_plain("open_dim", exposure=EXPOSURE, light=0.5),
    like_plain("dim", light=0.5),
    like_plain("bright", light=1.6),
    like_plain("soft", blur=1.5),
    like_plain("heavy", render_time=0.25),
)
AHEAD = (1.0, 0.0, 0.0, 0.0)
QPOS = pose_to_qpos((0.0, 0.0, 0.0), AHEAD)


@pytest.fixture(scope="module")
def renderer() -> Iterator[CameraRenderer]:
    """A wall of grey boxes, 2 m ahead, under a lamp and the camera's own light."""
    world = mujoco.MjSpec()
    world.visual.headlight.ambient = [0.2, 0.2, 0.2]
    world.visual.headlight.diffuse = [0.2, 0.2, 0.2]
    world.visual.headlight.specular = [0.0, 0.0, 0.0]
    world.worldbody.add_light(
        pos=[0, 0, 3], dir=[1, 0, -0.5], diffuse=[0.3, 0.3, 0.3], specular=[0, 0, 0]
    )
    for k in range(-12, 13):
        grey = 0.25 + 0.5 * (k % 2)
        world.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.1, 0.2, 4.0],
            pos=[2.1, 0.4 * k, 0.0],
            rgba=[grey, grey, grey, 1.0],
        )
    prefix = add_free_camera(world, "free", CAMERAS)
    made = CameraRenderer(model_to_bytes(world.compile()), CAMERAS, prefix, seed=0)
    yield made
    made.close()


def take(
    renderer: CameraRenderer,
    name: str,
    qpos: npt.NDArray[np.float64] = QPOS,
    qvel: npt.NDArray[np.float64] | None = None,
) -> Frame:
    return renderer.render(0, qpos, (name,), qvel)[name]


def rgb(frame: Frame) -> npt.NDArray[np.uint8]:
    assert frame.rgb is not None
    return frame.rgb


@pytest.mark.parametrize(
    ("velocity", "yaw_rate", "pixels"),
    [((0.0, 10.0, 0.0), 0.0, 4.8), ((0.0, 0.0, 0.0), 4.0, 7.2), ((0.0, 0.1, 0.0), 0.0, 0.05)],
)
def test_an_open_shutter_sees_the_mean_of_the_motion(
    renderer: CameraRenderer,
    velocity: tuple[float, float, float],
    yaw_rate: float,
    pixels: float,
) -> None:
    """Sideways, turning, and hardly at all: its light is the mean of that on the way."""

    def pose(seconds: float) -> npt.NDArray[np.float64]:
        x, y, z = (v * seconds for v in velocity)
        return pose_to_qpos((x, y, z), from_rpy(0.0, 0.0, yaw_rate * seconds))

    qvel = qvel_between(pose(-1e-3), pose(1e-3), 2e-3)
    seen = [rgb(take(renderer, "plain", pose(t))) for t in moments(EXPOSURE, pixels)]
    light = np.mean([srgb_light()[image] for image in seen], axis=0)
    expected = np.rint(np.interp(light, srgb_light(), np.arange(256)))
    found = rgb(take(renderer, "open", qvel=qvel))
    # The states differ in the last bits, and so may a pixel at an edge.
    assert (np.abs(found.astype(int) - expected) > 1).mean() < 0.002
    if pixels > 1.0:
        assert (np.abs(found.astype(int) - rgb(take(renderer, "plain"))) > 5).mean() > 0.1


def test_an_edge_becomes_as_wide_as_the_motion(renderer: CameraRenderer) -> None:
    """And its middle stays where the edge is at the stamp."""
    shift = 6.0
    focal = camera_info(PLAIN).fx
    velocity = shift / EXPOSURE * 2.0 / focal
    qvel = np.array([0.0, -velocity, 0.0, 0.0, 0.0, 0.0])  # to the right: west is +y here
    sharp, smeared = (
        srgb_light()[rgb(take(renderer, name, qvel=qvel))[32, :, 0]] for name in ("plain", "open")
    )
    middle = np.flatnonzero(np.abs(np.diff(sharp)) > 0.05)
    edge = middle[np.argmin(np.abs(middle - 48))]
    low, high = sharp[edge - 3], sharp[edge + 4]
    share = (smeared[edge - 4 : edge + 6] - low) / (high - low)
    assert share[0] == pytest.approx(0.0, abs=0.02)
    assert share[-1] == pytest.approx(1.0, abs=0.02)
    assert (1.0 - share).sum() == pytest.approx(5.0, abs=0.5)
    rising = ((share > 0.05) & (share < 0.95)).sum()
    assert shift - 2 <= rising <= shift + 1


def test_an_open_shutter_changes_nothing_but_colours(renderer: CameraRenderer) -> None:
    """Depth, numbers and pose are those of the stamp; and at rest, all is."""
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 3.0])
    sharp, smeared = (take(renderer, name, qvel=qvel) for name in ("plain", "open"))
    assert (smeared.position, smeared.orientation) == (sharp.position, sharp.orientation)
    for one, other in (
        (sharp.depth, smeared.depth),
        (sharp.segmentation, smeared.segmentation),
        (sharp.depth, take(renderer, "open_depth", qvel=qvel).depth),
        (rgb(sharp), rgb(take(renderer, "open", qvel=np.zeros(6)))),
        (rgb(sharp), rgb(take(renderer, "open"))),
    ):
        assert one is not None
        assert other is not None
        np.testing.assert_array_equal(one, other)


def test_grey_images_are_smeared_too(renderer: CameraRenderer) -> None:
    """As the colours are, though that camera gives no depth."""
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    frame = take(renderer, "open_grey", qvel=qvel)
    assert frame.depth is None
    assert frame.rgb is None
    assert frame.grey is not None
    np.testing.assert_array_equal(frame.grey, rgb(take(renderer, "open", qvel=qvel))[..., 0])


def test_light_is_a_factor(renderer: CameraRenderer) -> None:
    """On what is seen, where nothing is over-exposed; and on nothing else."""
    plain, dim, bright = (take(renderer, name) for name in ("plain", "dim", "bright"))
    assert rgb(plain).max() < 150
    np.testing.assert_allclose(rgb(dim), rgb(plain) * 0.5, atol=1.01)
    np.testing.assert_allclose(rgb(bright), rgb(plain) * 1.6, atol=1.8)
    assert plain.depth is not None
    np.testing.assert_array_equal(plain.depth, dim.depth)
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    smeared = rgb(take(renderer, "open", qvel=qvel))
    np.testing.assert_allclose(rgb(take(renderer, "open_dim", qvel=qvel)), smeared * 0.5, atol=1.51)


def test_cameras_keep_their_own_light(renderer: CameraRenderer) -> None:
    """Drawn one after the other from one scene, each is as it is alone."""
    names = ("dim", "plain", "bright", "open")
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    together = renderer.render(0, QPOS, names, qvel)
    for name in names:
        np.testing.assert_array_equal(
            rgb(together[name]), rgb(take(renderer, name, qvel=qvel)), err_msg=name
        )


def test_out_of_focus_is_a_blurred_image(renderer: CameraRenderer) -> None:
    sharp, soft = rgb(take(renderer, "plain")), rgb(take(renderer, "soft"))
    developed = Development(like_plain("soft", blur=1.5)).develop([sharp], generator(0, "soft", 0))
    np.testing.assert_array_equal(soft, developed)
    assert (
        np.abs(np.diff(soft[32, :, 0].astype(int))).max()
        < 0.6 * np.abs(np.diff(sharp[32, :, 0].astype(int))).max()
    )


def test_a_heavy_scene_takes_real_time(
    renderer: CameraRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What drawing does not use of `render_time` is slept, and the image is the same."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    heavy = rgb(take(renderer, "heavy"))
    assert 0.0 < slept[0] < 0.25
    np.testing.assert_array_equal(heavy, rgb(take(renderer, "plain")))
    assert slept[1:] == [0.0]


def test_a_velocity_of_the_wrong_length_is_named(renderer: CameraRenderer) -> None:
    with pytest.raises(ValueError, match=r"qvel: expected shape \(6,\), found \(7,\)"):
        renderer.render(0, QPOS, ("plain",), np.zeros(7))


def test_velocity_between_two_poses() -> None:
    """Along north, west and up; turning about the body's own axes, in MuJoCo's."""
    before = pose_to_qpos((1.0, 2.0, 3.0), from_rpy(0.0, 0.0, 0.4))
    after = pose_to_qpos((1.2, 2.0, 2.9), from_rpy(0.0, 0.0, 0.5))
    found = qvel_between(before, after, 0.1)
    np.testing.assert_allclose(found, [2.0, 0.0, 1.0, 0.0, 0.0, -1.0], atol=1e-9)
    nose_up = from_rpy(0.0, 0.1, math.pi / 2)
    before, after = (
        pose_to_qpos((0.0, 0.0, 0.0), q) for q in (from_rpy(0, 0, math.pi / 2), nose_up)
    )
    np.testing.assert_allclose(qvel_between(before, after, 0.1)[3:], [0.0, -1.0, 0.0], atol=1e-9)
