"""What a camera's settings do to its images, and what they leave alone.

Automatic exposure comes right, stays within its limits and never oscillates, however late.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events.camera_info import srgb_light
from events.frames import from_rpy
from runtime.units import Latency
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
from sims.cameras.optics import AutoExposure, ExposureControl, generator, moments
from tests.sims.cameras.scenes import frames_of, renderer_of

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
def renderer(draws: str) -> Iterator[CameraRenderer]:
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
    made = renderer_of(model_to_bytes(world.compile()), CAMERAS, prefix, seed=0)
    yield made
    made.close()


def take(
    renderer: CameraRenderer,
    name: str,
    qpos: npt.NDArray[np.float64] = QPOS,
    qvel: npt.NDArray[np.float64] | None = None,
) -> Frame:
    return frames_of(renderer, 0, qpos, (name,), qvel)[name]


def rgb(frame: Frame) -> npt.NDArray[np.uint8]:
    assert frame.rgb is not None
    return frame.rgb


@pytest.mark.parametrize(
    ("velocity", "yaw_rate", "pixels"),
    [((0.0, 10.0, 0.0), 0.0, 4.8), ((0.0, 0.0, 0.0), 4.0, 7.2), ((0.0, 0.1, 0.0), 0.0, 0.05)],
)
def test_an_open_shutter_sees_the_mean_of_the_motion(
    renderer: CameraRenderer, velocity: tuple[float, float, float], yaw_rate: float, pixels: float
) -> None:
    """Sideways, turning, and hardly at all: its light is the mean of that on the way."""

    def pose(seconds: float) -> npt.NDArray[np.float64]:
        x, y, z = (v * seconds for v in velocity)
        return pose_to_qpos((x, y, z), from_rpy(0.0, 0.0, yaw_rate * seconds))

    qvel = qvel_between(pose(-1e-3), pose(1e-3), 2e-3)
    seen = [rgb(take(renderer, "plain", pose(t))) for t in moments(EXPOSURE, pixels)]
    light = np.mean([srgb_light()[image] for image in seen], axis=0)
    expected = np.rint(np.interp(light, srgb_light(), np.arange(256)))
    blurred = rgb(take(renderer, "open", qvel=qvel))
    # The states differ in the last bits, and so may a pixel at an edge.
    assert (np.abs(blurred.astype(int) - expected) > 1).mean() < 0.002
    if pixels > 1.0:
        assert (np.abs(blurred.astype(int) - rgb(take(renderer, "plain"))) > 5).mean() > 0.1


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
    np.testing.assert_allclose(rgb(bright), rgb(plain) * 1.6, atol=2.51)
    assert plain.depth is not None
    np.testing.assert_array_equal(plain.depth, dim.depth)
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    smeared = rgb(take(renderer, "open", qvel=qvel))
    np.testing.assert_allclose(rgb(take(renderer, "open_dim", qvel=qvel)), smeared * 0.5, atol=1.51)


def test_cameras_keep_their_own_light(renderer: CameraRenderer) -> None:
    """Drawn one after the other from one scene, each is as it is alone."""
    names = ("dim", "plain", "bright", "open")
    qvel = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    together = frames_of(renderer, 0, QPOS, names, qvel)
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
    assert len(slept) == 1


def test_a_velocity_of_the_wrong_length_is_named(renderer: CameraRenderer) -> None:
    with pytest.raises(ValueError, match=r"qvel: expected shape \(6,\), found \(7,\)"):
        frames_of(renderer, 0, QPOS, ("plain",), np.zeros(7))


def test_velocity_between_two_poses() -> None:
    """Along north, west and up; turning about the body's own axes, in MuJoCo's."""
    before = pose_to_qpos((1.0, 2.0, 3.0), from_rpy(0.0, 0.0, 0.4))
    after = pose_to_qpos((1.2, 2.0, 2.9), from_rpy(0.0, 0.0, 0.5))
    velocity = qvel_between(before, after, 0.1)
    np.testing.assert_allclose(velocity, [2.0, 0.0, 1.0, 0.0, 0.0, -1.0], atol=1e-9)
    nose_up = from_rpy(0.0, 0.1, math.pi / 2)
    before, after = (
        pose_to_qpos((0.0, 0.0, 0.0), q) for q in (from_rpy(0, 0, math.pi / 2), nose_up)
    )
    np.testing.assert_allclose(qvel_between(before, after, 0.1)[3:], [0.0, -1.0, 0.0], atol=1e-9)


PERIOD = 33_333_333
REFERENCE = 0.002
AUTO = AutoExposure()


def loop(
    scene: float,
    frames: int = 40,
    delay: int = 2,
    auto: AutoExposure = AUTO,
    start: float = REFERENCE,
    seed: int = 0,
    noise: float = 1.0,
) -> list[tuple[float, float, float]]:
    """Return exposure time, gain and metered light of the images of a scene.

    Args:
        scene: Its brightness: 1 is as bright as it is drawn.
        frames: Number of images.
        delay: Images that are exposed before the first is delivered.
        auto: Settings.
        start: Exposure time to begin with.
        seed: Of the scene's texture.
        noise: Of the images, grey levels.
    """
    drawn = np.random.default_rng(seed).integers(0, 256, (24, 32), np.uint8)
    spec = CameraSpec(
        name="c",
        width=32,
        height=24,
        noise=noise,
        exposure=Latency(REFERENCE / scene),
        reference_exposure=Latency(REFERENCE / scene),
    )
    development, control = Development(spec), ExposureControl(auto, start)
    waiting: deque[tuple[int, float, float, float]] = deque()
    seen = []
    for number in range(frames):
        stamp = number * PERIOD
        while waiting and waiting[0][0] <= stamp:
            control.delivered(*waiting.popleft())
        exposure, gain = control.next(stamp)
        image = development.develop([drawn], generator(seed, "c", stamp), exposure, gain)
        light = development.meter(image)
        waiting.append((stamp + delay * PERIOD - 1, exposure, gain, light))
        seen.append((exposure, gain, light))
    return seen


@pytest.mark.parametrize("scene", [20.0, 1.0, 0.05])
@pytest.mark.parametrize("delay", [1, 2, 4])
def test_a_scene_twenty_times_brighter_or_darker_comes_right(scene: float, delay: int) -> None:
    """Ten images if two are on their way, 17 if four; the darker one by gain; and it stays so."""
    seen = loop(scene, delay=delay)
    for _, _, light in seen[{1: 7, 2: 10, 4: 17}[delay] :]:
        assert light == pytest.approx(AUTO.target, rel=0.1)
    exposure, gain, _ = seen[-1]
    assert (gain > 1.0) == (exposure == pytest.approx(AUTO.max_exposure) and scene < 1.0)


def test_a_change_of_the_light_has_no_effect_before_its_image_is_delivered() -> None:
    """And not on an exposure that begins at the very moment of a delivery."""
    control = ExposureControl(AUTO, REFERENCE)
    first = control.next(0)
    control.delivered(50, *first, light=0.02)
    assert control.next(50) == first
    assert control.next(51) != first


def test_time_comes_before_gain() -> None:
    """No gain as long as a longer exposure will do, in whole steps of both."""
    for scene in np.geomspace(0.02, 50.0, 12):
        exposure, gain, _ = loop(float(scene))[-1]
        rows = exposure / AUTO.exposure_step
        assert rows == pytest.approx(round(rows), abs=1e-6)
        decibels = 20.0 * np.log10(gain) / AUTO.gain_step
        assert decibels == pytest.approx(round(decibels), abs=1e-6)
        if gain > 1.0:
            assert exposure == pytest.approx(AUTO.max_exposure)


@pytest.mark.slow
@given(
    scene=st.floats(0.002, 500.0),
    start=st.floats(1e-5, 0.1),
    delay=st.integers(1, 5),
    damping=st.floats(0.0, 0.9),
    target=st.floats(0.05, 0.5),
    step=st.floats(2e-5, 2e-3),
    seed=st.integers(0, 9),
)
@settings(max_examples=60, deadline=None)
def test_it_stays_within_limits_and_never_oscillates(
    scene: float, start: float, delay: int, damping: float, target: float, step: float, seed: int
) -> None:
    """Brightness of the camera goes one way; a way back is no more than a step of the settings."""
    auto = msgspec.structs.replace(
        AUTO,
        damping=damping,
        target=target,
        exposure_step=Latency(step),
        min_exposure=Latency(2 * step),
        max_exposure=Latency(20 * step),
    )
    seen = loop(scene, 60, delay, auto, start, seed, noise=0.0)
    products = np.array([exposure * gain for exposure, gain, _ in seen])
    for exposure, gain, _ in seen:
        assert auto.min_exposure - 1e-12 <= exposure <= auto.max_exposure + 1e-12
        assert 1.0 <= gain <= auto.max_gain
    up, down = np.diff(products).clip(min=0).sum(), -np.diff(products).clip(max=0).sum()
    one_step = max(step, 0.07 * products.max())
    assert min(up, down) <= one_step + 1e-12


def test_a_black_image_asks_for_more_and_not_for_everything() -> None:
    control = ExposureControl(AUTO, REFERENCE)
    exposure, gain = control.next(0)
    control.delivered(1, exposure, gain, 0.0)
    brighter, gain = control.next(2)
    assert 2.0 < brighter * gain / exposure < 8.0


@pytest.mark.parametrize(
    "wrong", [{"exposure_step": 0.0}, {"min_exposure": 5e-6}, {"min_exposure": 0.02}]
)
def test_limits_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected 0 < step ≤ min ≤ max"):
        AutoExposure(**{key: Latency(value) for key, value in wrong.items()})
