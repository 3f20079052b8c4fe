"""The truth, made worse: exactly by as much, and as late, as the settings say."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import EstimatorAnnouncement, Odometry, PoseEstimate
from events.frames import from_yaw, yaw_of
from nodes.estimators.synthetic_odometry import SyntheticOdometry
from runtime.testing import NodeResult, run_node

MS = 1_000_000


def flight(seconds: float = 1.0) -> list[Odometry]:
    """Fly north at 2 m/s, from 3 m east of the origin."""
    return [
        Odometry(
            stamp=k * 10 * MS,
            source="drone",
            position=(2.0 * k / 100, 3.0, -1.5),
            orientation=from_yaw(0.3),
            linear_velocity=(2.0, 0.0, 0.0),
            angular_velocity=(0.0, 0.0, 0.0),
        )
        for k in range(round(seconds * 100))
    ]


def estimates(seed: int = 0, **config: Any) -> list[tuple[PoseEstimate, Odometry]]:
    truth = {event.stamp: event for event in flight()}
    result = run_node(SyntheticOdometry, inputs=truth.values(), config=config, seed=seed)
    return [(estimate, truth[estimate.stamp]) for estimate in result.of(PoseEstimate)]


def result(**config: Any) -> NodeResult:
    return run_node(SyntheticOdometry, inputs=flight(), config=config)


def test_without_errors_it_is_the_truth_at_its_rate() -> None:
    pairs = estimates(rate=20, latency="0ms")
    assert len(pairs) == 20
    for said, truth in pairs:
        assert (said.frame_id, said.child_frame_id) == ("map", "base_link")
        np.testing.assert_allclose(said.position, truth.position, atol=1e-12)
        np.testing.assert_allclose(said.orientation, truth.orientation, atol=1e-12)


@settings(max_examples=12)
@given(st.integers(0, 9), st.floats(0.01, 20))
def test_drift_is_the_share_of_the_distance_flown(seed: int, drift: float) -> None:
    for said, truth in estimates(seed, drift=drift):
        error = np.subtract(said.position, truth.position)
        assert math.hypot(*error) == pytest.approx(drift / 100 * truth.position[0], abs=1e-9)
        assert error[2] == 0.0


@settings(max_examples=12)
@given(st.integers(0, 9), st.floats(0.01, 20))
def test_the_heading_drifts_and_the_path_turns_with_it(seed: int, drift: float) -> None:
    signs = set()
    for said, truth in estimates(seed, heading_drift=drift)[1:]:
        flown = truth.position[0]
        turned = yaw_of(said.orientation) - yaw_of(truth.orientation)
        assert abs(turned) == pytest.approx(math.radians(drift * flown), abs=1e-9)
        signs.add(math.copysign(1, turned))
        path = np.subtract(said.position, (0.0, 3.0, -1.5))
        np.testing.assert_allclose(
            path, (flown * math.cos(turned), flown * math.sin(turned), 0), atol=1e-9
        )
    assert len(signs) == 1


def test_an_estimate_is_late_by_the_latency() -> None:
    """Those that are still on their way when the run ends do not arrive."""
    assert len(result(rate=20, latency="200ms").of(PoseEstimate)) == 16


@pytest.mark.slow
def test_noise_has_the_size_that_the_settings_say() -> None:
    errors = [
        np.subtract(said.position, truth.position)
        for seed in range(20)
        for said, truth in estimates(seed, rate=100, noise=0.05, latency="0ms")
    ]
    assert np.std(errors) == pytest.approx(0.05, rel=0.05)


def test_its_announcement_says_what_it_is() -> None:
    said = next(e for e in result(drift=2).sent if isinstance(e, EstimatorAnnouncement))
    assert said.method == "truth, 2 % drift, 15 ms late"


def test_it_sends_a_velocity_if_it_is_told_to() -> None:
    assert all(said.velocity is None for said, _ in estimates())
    pairs = estimates(velocity_noise=0.0, heading_drift=10.0)
    for said, _ in pairs:
        assert said.velocity is not None
        yaw = yaw_of(said.orientation)
        ahead = (2.0 * math.cos(yaw), 2.0 * math.sin(yaw), 0.0)
        np.testing.assert_allclose(said.velocity, ahead, atol=1e-12)
    last, truth = pairs[-1]
    assert yaw_of(last.orientation) != pytest.approx(yaw_of(truth.orientation), abs=0.1)
    noisy = [said.velocity for said, _ in estimates(velocity_noise=0.1)]
    assert 0.05 < np.std([velocity[2] for velocity in noisy if velocity]) < 0.2
