"""Means are over images or equal times, within pieces of the truth, at the sparser one's stamps."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo
from evo.core.units import Unit
from hypothesis import given
from hypothesis import strategies as st

from nodes.judging.evaluation.judging import judge, one_a_step, one_an_image
from nodes.judging.evaluation.metrics import path_pairs
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory, pair
from tests.nodes.trajectory.samples import as_evo, noisy, walk

MS, SECOND = 1_000_000, 1_000_000_000


def circle(times: np.ndarray, radius: float = 5.0, speed: float = 1.0) -> Trajectory:
    """Return a level circle at times (s), heading along it, in m and m/s."""
    angle = times * speed / radius
    positions = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    half = (angle + np.pi / 2) / 2
    zero = np.zeros_like(half)
    quaternions = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    return Trajectory(np.round(times * SECOND).astype(np.int64), positions, quaternions)


TRUTH = circle(np.arange(0.0, 60.0, 0.005))
FRAMES = np.round(np.arange(0.0, 59.9, 0.05) * SECOND).astype(np.int64)


def drifting(times: np.ndarray) -> Trajectory:
    """Return poses that are 2 m off in the second half."""
    exact = circle(times)
    off = np.where(times > 30.0, 2.0, 0.0)
    return Trajectory(exact.stamps, exact.positions + off[:, None], exact.orientations)


def test_many_poses_where_it_is_easy_do_not_hide_where_it_is_not() -> None:
    images = FRAMES / 1e9
    extra = np.arange(10.0, 15.0, 0.000125)
    times = np.unique(np.round(np.concatenate([images, extra]), 6))
    honest = judge(
        EstimatorRecord.of(drifting(images)), TRUTH, cameras={"c": FRAMES}, alignment="none"
    ).figures
    diluted = judge(
        EstimatorRecord.of(drifting(times)), TRUTH, cameras={"c": FRAMES}, alignment="none"
    ).figures
    assert honest["ate_rmse_m"] == pytest.approx(np.sqrt(3) * 2.0 * np.sqrt(0.5), rel=0.01)
    for name in ("ate_rmse_m", "ate_percent", "rpe_1m_trans_percent", "rpe_mean_trans_percent"):
        assert diluted[name] == pytest.approx(honest[name], rel=1e-9), name
    unseen = judge(EstimatorRecord.of(drifting(times)), TRUTH, alignment="none")
    assert unseen.figures["ate_rmse_m"] == pytest.approx(honest["ate_rmse_m"], rel=0.02)
    assert f"of {len(times)} poses in bursts" in unseen.note


@given(
    st.lists(st.integers(0, 10_000), min_size=1, max_size=40, unique=True).map(sorted),
    st.integers(1, 60),
)
def test_an_image_has_one_pose_and_a_pose_one_image(poses: list[int], count: int) -> None:
    frames = np.arange(count) * 100
    mask = one_an_image(frames, np.array(poses))
    distances = abs(np.array(poses)[:, None] - frames)
    near = 2 * distances.min(axis=1) <= (100 if count > 1 else 0)
    if not near.any():
        assert mask.all()
        return
    images = distances.argmin(axis=1)
    assert not mask[~near].any()
    assert len(set(images[mask])) == mask.sum()
    assert set(images[mask]) == set(images[near])
    for image in set(images[near]):
        chosen = distances[mask & (images == image), image]
        assert chosen.tolist() == [distances[near & (images == image), image].min()]


@pytest.mark.parametrize(("burst", "count"), [(4, 40), (5, 10)])
def test_bursts_are_more_than_four_poses_a_step(burst: int, count: int) -> None:
    stamps = (np.arange(10)[:, None] * SECOND + np.arange(burst) * MS).ravel()
    mask = one_a_step(stamps)
    assert mask.sum() == count
    assert mask[::burst].all()


def test_key_frames_at_uneven_times_all_weigh() -> None:
    steps = np.random.default_rng(0).uniform(0.1, 2.0, 200)
    assert one_a_step(np.round(np.cumsum(steps) * 1e9).astype(np.int64)).all()


def test_a_sparse_truth_is_not_interpolated() -> None:
    estimate = circle(np.arange(0.0, 60.0, 0.05))
    truth = circle(np.arange(0.0, 60.0, 1.0))
    there, kept = pair(truth, estimate)
    assert len(there) == len(kept) == 60
    assert (there.positions == truth.positions).all()
    figures = judge(EstimatorRecord.of(estimate), truth, alignment="se3").figures
    # Interpolated, the truth is off by a chord: 25 mm and 5.7 degrees in the middle.
    assert figures["ate_rmse_m"] < 1e-4
    assert figures["rot_rmse_deg"] < 1e-3
    assert figures["compared"] == 60
    assert figures["compared_percent"] == 100.0
    assert figures["path_m"] == pytest.approx(59.0, rel=0.01)


def test_a_handful_of_compared_poses_is_a_small_share() -> None:
    truth = circle(np.arange(0.0, 60.0, 12.0))
    figures = judge(
        EstimatorRecord.of(circle(np.arange(0.0, 60.0, 0.05))), truth, alignment="se3"
    ).figures
    assert figures["compared"] == 5
    assert figures["compared_percent"] == pytest.approx(100 * 9 / 60, abs=1.0)


def test_pieces_of_the_truth_are_pieces() -> None:
    """A hole at one place: drift over it is no error over a metre, and its chord no path."""
    times = np.arange(0.0, 60.0, 0.05)
    lap = 10 * np.pi
    exact = circle(times)
    drift = np.zeros((len(times), 3))
    drift[:, 2] = 0.05 * times
    estimate = Trajectory(exact.stamps, exact.positions + drift, exact.orientations)
    known = (TRUTH.stamps < 10 * SECOND) | (TRUTH.stamps >= (10 + lap) * SECOND)
    record = EstimatorRecord.of(estimate)
    whole = judge(record, TRUTH, alignment="origin").figures
    pieces = judge(record, TRUTH.take(known), alignment="origin").figures
    assert whole["rpe_1m_trans_percent"] == pytest.approx(5.0, rel=0.02)
    assert pieces["rpe_1m_trans_percent"] == pytest.approx(5.0, rel=0.02)
    assert pieces["rpe_frame_trans_m"] == pytest.approx(whole["rpe_frame_trans_m"], rel=1e-6)
    assert pieces["rpe_mean_trans_percent"] == pytest.approx(5.0, rel=0.1)
    assert pieces["path_m"] == pytest.approx(whole["path_m"] - lap, abs=0.02)
    assert "end_error_percent" in whole
    assert "end_error_percent" not in pieces
    assert pieces["compared_percent"] < 60.0


def test_pairs_of_pieces_are_those_of_each_as_evo_has_them() -> None:
    truth = walk(400)
    estimate = noisy(truth, metres=0.005)
    pieces = np.repeat([0, 3], [150, 250])
    first, second = path_pairs(truth.distances(), 0.5, pieces=pieces)
    assert (pieces[first] == pieces[second]).all()
    errors = []
    for rows in (slice(0, 150), slice(150, 400)):
        metric = evo.RPE(evo.PoseRelation.translation_part, 0.5, Unit.meters, 0.1, True, True)
        metric.process_data((as_evo(truth.take(rows)), as_evo(estimate.take(rows))))
        errors += list(metric.error)
    assert len(first) == len(errors)


def test_the_chord_of_a_hole_is_no_path() -> None:
    known = (TRUTH.stamps <= 10 * SECOND) | (TRUTH.stamps >= 25 * SECOND)
    truth = TRUTH.take(known)
    assert truth.distances()[-1] == pytest.approx(60.0 - 15.0 + 10.0 * np.sin(1.5), abs=0.02)
    figures = judge(
        EstimatorRecord.of(circle(np.arange(0.0, 60.0, 0.05))), truth, alignment="origin"
    ).figures
    assert figures["path_m"] == pytest.approx(60.0 - 15.0, abs=0.02)


def test_the_alignment_may_be_of_the_beginning() -> None:
    estimate = drifting(FRAMES / 1e9)  # right in the first half
    record = EstimatorRecord.of(estimate)
    for first in (200, 10.0):
        figures = judge(record, TRUTH, alignment="se3", align_first=first).figures
        assert figures["ate_max_m"] == pytest.approx(2.0 * np.sqrt(3.0), rel=1e-3)
    assert judge(record, TRUTH, alignment="se3").figures["ate_max_m"] < 3.2
