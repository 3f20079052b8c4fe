"""Automatic exposure comes right, stays within its limits and never oscillates, however late."""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.units import Latency
from sims.cameras import CameraSpec
from sims.cameras.development import Development
from sims.cameras.exposure import AutoExposure, ExposureControl
from sims.cameras.noise import generator

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
    "wrong",
    [
        {"exposure_step": 0.0},
        {"min_exposure": 5e-6},
        {"min_exposure": 0.02},
    ],
)
def test_limits_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected 0 < step ≤ min ≤ max"):
        AutoExposure(**{key: Latency(value) for key, value in wrong.items()})
