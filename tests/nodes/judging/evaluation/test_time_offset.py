"""The offset between two clocks is found, told, and not applied."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.time_offset import best_time_offset
from nodes.trajectory import Trajectory
from tests.nodes.trajectory.samples import moved

SECOND = 1_000_000_000
TIMES = np.arange(0.0, 90.0, 0.01)


def flight(times: np.ndarray) -> Trajectory:
    """Return a flight that slows down and turns, at times in seconds."""
    along = times + 0.8 * np.sin(0.9 * times) + 0.3 * np.sin(2.3 * times + 1.0)
    positions = np.stack(
        [5 * np.cos(along / 5), 4 * np.sin(along / 5), 1 + 0.5 * np.sin(along / 3)], axis=1
    )
    half = along / 10
    zero = np.zeros_like(half)
    quaternions = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    return Trajectory(np.round(times * SECOND).astype(np.int64), positions, quaternions)


TRUTH = flight(TIMES)


def late(estimate: Trajectory, seconds: float) -> Trajectory:
    """Return an estimate with stamps of a clock that is ahead."""
    stamps = estimate.stamps + round(seconds * SECOND)
    return Trajectory(stamps, estimate.positions, estimate.orientations)


@given(seconds=st.floats(-25.0, 25.0), scale=st.sampled_from([1.0, 0.3]))
@settings(max_examples=12, deadline=None)
def test_an_offset_is_found(seconds: float, scale: float) -> None:
    estimate = moved(late(flight(np.arange(30.0, 62.0, 0.05)), seconds), scale)
    offset = best_time_offset(TRUTH, estimate, with_scale=True)
    assert offset is not None
    assert offset.seconds == pytest.approx(-seconds, abs=1e-4)
    assert offset.after < 1e-3


@pytest.mark.parametrize(("truth_step", "step"), [(0.01, 0.05), (1.0, 0.05)])
def test_the_sparser_one_may_be_the_truth(truth_step: float, step: float) -> None:
    truth = flight(np.arange(0.0, 90.0, truth_step))
    offset = best_time_offset(truth, late(flight(np.arange(5.0, 80.0, step)), 0.3))
    assert offset is not None
    assert offset.seconds == pytest.approx(-0.3, abs=2e-3)
    assert offset.matters


def test_a_judgement_tells_it_and_does_not_apply_it() -> None:
    estimate = late(flight(np.arange(20.0, 60.0, 0.05)), 18.0)
    judgement = judge(EstimatorRecord.of(estimate), TRUTH, alignment="se3")
    assert judgement.figures["time_offset_ms"] == pytest.approx(-18_000.0, abs=0.1)
    assert judgement.figures["ate_rmse_m"] > 1.0
    assert "with -18.0000 s added to its stamps it would fit far better" in judgement.note


def test_clocks_with_nothing_in_common_are_brought_together() -> None:
    estimate = late(flight(np.arange(20.0, 60.0, 0.05)), 1_700_000_000.0)
    judgement = judge(EstimatorRecord.of(estimate), TRUTH, alignment="se3")
    assert "one is Unix time" in judgement.figures["why"]
    assert "with -1700000000.0000 s added to its stamps it would fit" in judgement.figures["why"]


def test_an_estimate_on_the_truths_clock_has_no_offset() -> None:
    judgement = judge(
        EstimatorRecord.of(flight(np.arange(20.0, 60.0, 0.05))), TRUTH, alignment="se3"
    )
    assert judgement.figures["time_offset_ms"] == pytest.approx(0.0, abs=0.1)
    assert judgement.note == ""


def test_a_circle_at_constant_speed_tells_no_offset() -> None:
    angles = TIMES[:2000] / 2
    positions = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    positions += np.random.default_rng(0).normal(0.0, 0.01, positions.shape)
    circle = Trajectory(TRUTH.stamps[:2000], positions, TRUTH.orientations[:2000])
    offset = best_time_offset(circle, circle.take(slice(0, 2000, 5)))
    assert offset is not None
    assert abs(offset.seconds) < 1e-3
    assert not offset.matters


def test_an_offset_of_a_millisecond_is_no_other_clock() -> None:
    offset = best_time_offset(TRUTH, late(flight(np.arange(20.0, 60.0, 0.05)), 0.001))
    assert offset is not None
    assert offset.seconds == pytest.approx(-0.001, abs=1e-4)
    assert not offset.matters


def test_a_flight_that_begins_on_a_line_has_no_other_clock() -> None:
    """What two offsets have in common may be a straight climb, which tells nothing of either."""
    times = np.arange(0.0, 4.0, 0.01)
    climb = np.minimum(times, 2.0) + 0.1 * np.sin(3.0 * times)
    aside = 0.3 * np.maximum(times - 2.0, 0.0) ** 2
    positions = np.stack([aside, 0.2 * aside**2, -climb], axis=1)
    stamps = np.round(times * SECOND).astype(np.int64)
    truth = Trajectory(stamps, positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1)))
    noise = np.random.default_rng(1).normal(0.0, 0.02, (80, 3))
    rows = truth.take(slice(0, 400, 5))
    estimate = Trajectory(rows.stamps, rows.positions + noise, rows.orientations)
    offset = best_time_offset(truth, estimate)
    assert offset is None or not offset.matters
    assert offset is None or offset.before < np.inf
