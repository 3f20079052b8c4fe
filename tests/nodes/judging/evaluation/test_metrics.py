"""Our errors are evo's, and what we define ourselves is what we say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from evo.core import metrics as evo
from evo.core.filters import filter_pairs_by_path
from evo.core.units import Unit
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from events.frames import angle_between
from nodes.judging.evaluation.alignment import align
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.metrics import (
    absolute_errors,
    consistency,
    end_error_percent,
    frame_errors,
    interpolated,
    path_errors,
    path_pairs,
    rotation_errors,
    segment_errors,
)
from nodes.judging.evaluation.orientations import examine
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory, associate
from nodes.trajectory_files import read_tum
from runtime.figures import KITTI_LENGTHS, SHARES
from tests.nodes.trajectory.samples import as_evo, moved, noisy, walk

ROOT = Path(__file__).parents[4]
SEEDS = st.integers(0, 2**32 - 1)


def ape(truth: Trajectory, estimate: Trajectory, relation: Any) -> dict[str, float]:
    metric = evo.APE(relation)
    metric.process_data((as_evo(truth), as_evo(estimate)))
    return dict(metric.get_all_statistics())


def rpe(truth: Trajectory, estimate: Trajectory, relation: Any, *options: Any) -> Any:
    metric = evo.RPE(relation, *options)
    metric.process_data((as_evo(truth), as_evo(estimate)))
    return metric


@given(seed=SEEDS, n=st.integers(1, 80))
@settings(max_examples=20, deadline=None)
def test_absolute_errorss_are_evos(seed: int, n: int) -> None:
    truth = walk(n, seed)
    estimate = noisy(truth, seed=seed + 1)
    ours = absolute_errors(truth, estimate)
    shifts = ape(truth, estimate, evo.PoseRelation.translation_part)
    for name in ("rmse", "mean", "median", "std", "max"):
        assert ours[f"ate_{name}_m"] == pytest.approx(shifts[name], abs=1e-9)
    turns = ape(truth, estimate, evo.PoseRelation.rotation_angle_deg)
    assert ours["rot_rmse_deg"] == pytest.approx(turns["rmse"], abs=1e-9)


@pytest.mark.slow
@given(seed=SEEDS, n=st.integers(30, 120), delta=st.sampled_from([0.2, 1.0]))
@settings(max_examples=10, deadline=None)
def test_relative_errors_are_evos(seed: int, n: int, delta: float) -> None:
    truth = walk(n, seed)
    estimate = noisy(truth, metres=0.005, seed=seed + 1)
    ours = path_errors(truth, estimate, delta)
    options = (delta, Unit.meters, 0.1, True, True)
    shifts = rpe(truth, estimate, evo.PoseRelation.translation_part, *options)
    turns = rpe(truth, estimate, evo.PoseRelation.rotation_angle_deg, *options)
    values = ours[f"rpe_{delta:g}m_trans_percent"] / 100, ours[f"rpe_{delta:g}m_rot_deg_per_m"]
    for metric, rmse in zip((shifts, turns), values, strict=True):
        assert rmse * delta == pytest.approx(metric.get_all_statistics()["rmse"], abs=1e-9)


@given(seed=SEEDS, n=st.integers(2, 80))
@settings(max_examples=10, deadline=None)
def test_errors_from_pose_to_pose_are_those_of_evos_default(seed: int, n: int) -> None:
    truth = walk(n, seed)
    estimate = noisy(truth, seed=seed + 1)
    ours = frame_errors(truth, estimate)
    shifts = rpe(truth, estimate, evo.PoseRelation.translation_part)
    turns = rpe(truth, estimate, evo.PoseRelation.rotation_angle_deg)
    assert ours["rpe_frame_trans_m"] == pytest.approx(shifts.get_all_statistics()["rmse"], abs=1e-9)
    assert ours["rpe_frame_rot_deg"] == pytest.approx(turns.get_all_statistics()["rmse"], abs=1e-9)


def test_a_real_flights_errors_are_evos() -> None:
    """As from 200 Hz truth, with the vehicle at rest at both ends, and an estimate at 30 Hz."""
    orbit = read_tum(ROOT / "examples" / "orbit.tum")
    rest = 5_000_000 * np.arange(1, 201)
    waiting = [np.tile(orbit.positions[i], (200, 1)) for i in (0, -1)]
    turned = [np.tile(orbit.orientations[i], (200, 1)) for i in (0, -1)]
    flight = orbit.at(np.arange(orbit.stamps[0], orbit.stamps[-1], 5_000_000))
    truth = Trajectory(
        np.concatenate([flight.stamps[0] - rest[::-1], flight.stamps, flight.stamps[-1] + rest]),
        np.concatenate([waiting[0], flight.positions, waiting[1]]),
        np.concatenate([turned[0], flight.orientations, turned[1]]),
    )
    stamps = np.arange(truth.stamps[0], truth.stamps[-1], 33_333_333)
    truth, estimate = associate(truth, noisy(truth.at(stamps), metres=0.003))
    estimate = align(estimate, truth, "se3").trajectory
    shifts = ape(truth, estimate, evo.PoseRelation.translation_part)
    assert absolute_errors(truth, estimate)["ate_rmse_m"] == pytest.approx(shifts["rmse"], abs=1e-9)
    options = (1.0, Unit.meters, 0.1, True, True)
    errors = path_errors(truth, estimate)
    relative = rpe(truth, estimate, evo.PoseRelation.translation_part, *options)
    assert len(relative.error) > 300
    rmse = relative.get_all_statistics()["rmse"]
    assert errors["rpe_1m_trans_percent"] / 100 == pytest.approx(rmse, abs=1e-9)
    relative = rpe(truth, estimate, evo.PoseRelation.rotation_angle_deg, *options)
    rmse = relative.get_all_statistics()["rmse"]
    assert errors["rpe_1m_rot_deg_per_m"] == pytest.approx(rmse, abs=1e-9)


steps = st.lists(st.sampled_from([0.0, 0.0, 0.1, 0.25, 0.5, 2.0]), min_size=1, max_size=40)


@given(steps=steps, delta=st.sampled_from([0.1, 0.5, 1.0, 1.3]))
@settings(deadline=None)
def test_pairs_are_evos_also_for_a_vehicle_that_stands_still_or_jumps(
    steps: list[float], delta: float
) -> None:
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps)
    distances = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(poses[:, 0, 3])))])
    first, second = path_pairs(distances, delta)
    theirs = filter_pairs_by_path(list(poses), delta, 0.1 * delta, all_pairs=True)
    # One a little short and one a little far may be equally near but for rounding; of those
    # that stand on one spot it is the first.
    ours = list(zip(first.tolist(), second.tolist(), strict=True))
    assert [i for i, _ in ours] == [i for i, _ in theirs]
    for (i, j), (_, k) in zip(ours, theirs, strict=True):
        misses = [abs(distances[end] - distances[i] - delta) for end in (j, k)]
        tie = distances[j] != distances[k] and misses[0] == pytest.approx(misses[1], abs=1e-12)
        assert j == k or tie


STRAIGHT = Trajectory(
    10**9 * (10**9 + np.arange(101)),
    np.arange(101.0)[:, None] * [1.0, 0.0, 0.0],
    np.tile([1.0, 0.0, 0.0, 0.0], (101, 1)),
)
"""100 m along x."""


ROLLS = Rotation.from_euler("x", 0.3 * np.arange(101)[:, None], degrees=True).as_quat(
    scalar_first=True
)
"""Orientations that roll by 0.3° a metre: seen from the body, the motion stays along x."""


def test_relative_errors_are_a_share_of_the_length_whatever_it_is() -> None:
    estimate = Trajectory(STRAIGHT.stamps, 1.1 * STRAIGHT.positions, ROLLS)
    shares = {f"rpe_{share}pct" for share in SHARES} | {"rpe_mean"}
    expected = {f"{name}_trans_percent": 10.0 for name in shares}
    expected |= {f"{name}_rot_deg_per_m": 0.3 for name in shares}
    # None of KITTI's, which are of longer paths; at its end, stretches may be a tenth too short.
    assert segment_errors(STRAIGHT, estimate, 100.0) == pytest.approx(expected, rel=3e-3)
    errors = path_errors(STRAIGHT, estimate, 4.0)
    assert errors == pytest.approx({"rpe_4m_trans_percent": 10.0, "rpe_4m_rot_deg_per_m": 0.3})
    assert end_error_percent(STRAIGHT, estimate) == pytest.approx(10.0)
    short = slice(0, 2)
    assert end_error_percent(STRAIGHT.take(short), estimate.take(short)) == pytest.approx(10.0)


def test_motions_from_pose_to_pose_stay_within_a_piece() -> None:
    pieces = np.repeat([0, 1, 2], [1, 50, 50])
    jumps = STRAIGHT.positions + pieces[:, None] * [0.0, 7.0, 0.0]
    estimate = Trajectory(STRAIGHT.stamps, jumps, ROLLS)
    errors = frame_errors(STRAIGHT, estimate, pieces)
    assert errors == pytest.approx({"rpe_frame_trans_m": 0.0, "rpe_frame_rot_deg": 0.3})
    with pytest.raises(ValueError, match="expected two poses in a piece, found 101"):
        frame_errors(STRAIGHT, estimate, np.arange(101))


@pytest.mark.parametrize("metres", [8.9, 9.0, 11.0, 11.1])
def test_a_pair_may_miss_its_length_by_a_tenth_and_leaves_no_piece(metres: float) -> None:
    distances = np.array([0.0, metres])
    kept = [0] * (9.0 <= metres <= 11.0)
    assert path_pairs(distances, 10.0)[0].tolist() == kept
    for row, pieces in ((1, [0, 1, 1]), (0, [0, 0, 1])):  # one of the two is alone
        first, second = path_pairs(np.append(distances, 2 * metres), 10.0, pieces=np.array(pieces))
        assert (first.tolist(), second.tolist()) == ([row] * len(kept), [row + 1] * len(kept))


def test_between_stamps_of_today_every_nanosecond_counts() -> None:
    known = 10**18 + np.array([0, 10, 20])
    values = np.array([[0.0, 5.0], [1.0, 5.0], [3.0, 5.0]])
    at = interpolated(known, values, 10**18 + np.array([5, 15, 15]))
    assert at == pytest.approx(np.array([[0.5, 5.0], [2.0, 5.0], [2.0, 5.0]]))


def test_no_pair_so_far_apart_is_an_error_that_says_how_long_the_path_is() -> None:
    truth = walk(10)
    with pytest.raises(ValueError, match=r"expected poses 1 m apart .* in 10 poses and 0\.450 m"):
        path_errors(truth, truth)


@pytest.mark.parametrize("delta", [0.0, -1.0, math.nan, math.inf])
def test_a_distance_that_is_none_is_an_error(delta: float) -> None:
    with pytest.raises(ValueError, match="expected a length above 0 m"):
        path_errors(walk(), walk(), delta)


def test_relative_errors_and_drift_do_not_depend_on_the_frame() -> None:
    truth = walk()
    estimate = noisy(truth)
    elsewhere = moved(estimate)
    assert end_error_percent(truth, elsewhere) == pytest.approx(end_error_percent(truth, estimate))
    ours, other = path_errors(truth, estimate), path_errors(truth, elsewhere)
    assert other == pytest.approx(ours)


def test_drift_is_the_error_at_the_end_over_the_true_path() -> None:
    truth = walk(101, step=0.1)  # 10 m
    positions = truth.positions.copy()
    positions[-1] += [0.0, 0.3, 0.4]
    estimate = Trajectory(truth.stamps, positions, truth.orientations)
    assert end_error_percent(truth, estimate) == pytest.approx(5.0)
    with pytest.raises(ValueError, match="expected a path longer than 0 m"):
        end_error_percent(truth.take(slice(0, 1)), estimate.take(slice(0, 1)))


def test_a_perfect_estimate_has_no_errors() -> None:
    truth = walk()
    errors = absolute_errors(truth, truth)
    assert errors["ate_max_m"] == 0.0
    assert errors["rot_rmse_deg"] < 1e-12
    assert path_errors(truth, truth)["rpe_1m_trans_percent"] < 1e-12
    assert end_error_percent(truth, truth) < 1e-12


@given(seed=SEEDS, radians=st.floats(0.0, math.pi))
def test_the_angle_of_one_pose_is_that_of_many(seed: int, radians: float) -> None:
    rng = np.random.default_rng(seed)
    a = Rotation.random(rng=rng)
    axis = rng.normal(size=3)
    b = a * Rotation.from_rotvec(radians * axis / np.linalg.norm(axis))
    p, q = a.as_quat(scalar_first=True), b.as_quat(scalar_first=True)
    assert angle_between(tuple(p), tuple(q)) == pytest.approx(radians, abs=1e-9)
    assert angle_between(tuple(p), tuple(-q)) == pytest.approx(radians, abs=1e-9)
    assert rotation_errors(p[None], q[None])[0] == pytest.approx(radians, abs=1e-9)


def test_errors_by_axis_are_those_of_the_axis_that_is_off() -> None:
    truth = walk(50)
    off = np.where(np.arange(50)[:, None] % 2, 1.0, -1.0) * [0.0, 0.2, 0.1]
    estimate = Trajectory(truth.stamps, truth.positions + off, truth.orientations)
    errors = absolute_errors(truth, estimate)
    axes = [errors[f"ate_{axis}_rmse_m"] for axis in ("north", "east", "down")]
    assert axes == pytest.approx([0.0, 0.2, 0.1], abs=1e-12)
    assert sum(value**2 for value in axes) == pytest.approx(errors["ate_rmse_m"] ** 2)


@pytest.mark.parametrize(
    "function",
    [
        absolute_errors,
        path_errors,
        end_error_percent,
        frame_errors,
        lambda truth, estimate: segment_errors(truth, estimate, 1.0),
        lambda truth, estimate: consistency(truth, estimate, np.eye(6)[None]),
        lambda truth, estimate: align(estimate, truth, "none"),
        examine,
    ],
)
def test_other_stamps_are_an_error_that_names_the_row(function: Any) -> None:
    truth = walk(5)
    late = Trajectory(truth.stamps + np.array([0, 0, 1, 1, 1]), truth.positions, truth.orientations)
    with pytest.raises(ValueError, match=r"found 100000000 ns .* 100000001 ns .* in row 2"):
        function(truth, late)
    with pytest.raises(ValueError, match=r"found 5 of the truth and 4 of the estimate"):
        function(truth, late.take(slice(0, 4)))


@pytest.mark.slow
@given(seed=SEEDS)
@settings(max_examples=8, deadline=None)
def test_errors_over_shares_of_the_path_are_the_means_of_evos(seed: int) -> None:
    truth = walk(300, seed)
    estimate = noisy(truth, metres=0.005, seed=seed + 1)
    path = truth.length()
    errors = segment_errors(truth, estimate, path)
    sums, count = 0.0, 0
    for share in SHARES:
        length = share / 100 * path
        options = (length, Unit.meters, 0.1, True, True)
        shifts = rpe(truth, estimate, evo.PoseRelation.translation_part, *options)
        turns = rpe(truth, estimate, evo.PoseRelation.rotation_angle_deg, *options)
        mean = 100 * shifts.get_all_statistics()["mean"] / length
        assert errors[f"rpe_{share}pct_trans_percent"] == pytest.approx(mean)
        mean = turns.get_all_statistics()["mean"] / length
        assert errors[f"rpe_{share}pct_rot_deg_per_m"] == pytest.approx(mean)
        sums, count = sums + 100 * shifts.error.sum() / length, count + len(shifts.error)
    assert errors["rpe_mean_trans_percent"] == pytest.approx(sums / count)


def as_kitti_has_it(truth: Trajectory, estimate: Trajectory, lengths: list[float]) -> float:
    """Return the mean translation error in percent by the definition of KITTI's page.

    Each pose begins a stretch, which ends at the first pose beyond the length.
    """
    distances = truth.distances()
    motions = [(np.linalg.inv(m), m) for m in (estimate.matrices(), truth.matrices())]
    errors = []
    for length in lengths:
        for first in range(len(truth)):
            beyond = np.flatnonzero(distances > distances[first] + length)
            if len(beyond):
                a, b = (inverse[first] @ m[beyond[0]] for inverse, m in motions)
                errors.append(np.linalg.norm((np.linalg.inv(a) @ b)[:3, 3]) / length)
    return 100.0 * float(np.mean(errors))


def test_the_mean_over_shares_is_about_kittis() -> None:
    """But for the end of a stretch, which is nearer to its length here."""
    truth = walk(1200, step=0.01)
    estimate = noisy(truth, metres=0.002)
    lengths = [share / 100 * truth.length() for share in SHARES]
    expected = as_kitti_has_it(truth, estimate, lengths)
    errors = segment_errors(truth, estimate, truth.length())
    assert errors["rpe_mean_trans_percent"] == pytest.approx(expected, rel=0.02)
    assert not {name for name in errors if "kitti" in name or "0m" in name}  # the path is too short


def test_the_errors_over_kittis_lengths_are_kittis() -> None:
    truth = walk(1200, step=0.3)
    estimate = noisy(truth, metres=0.02)
    assert 300.0 < truth.length() < 400.0
    errors = segment_errors(truth, estimate, truth.length())
    for length in KITTI_LENGTHS[:3]:
        expected = as_kitti_has_it(truth, estimate, [float(length)])
        assert errors[f"rpe_{length}m_trans_percent"] == pytest.approx(expected, rel=0.15)
    expected = as_kitti_has_it(truth, estimate, [100.0, 200.0, 300.0])
    assert errors["rpe_kitti_trans_percent"] == pytest.approx(expected, rel=0.15)
    assert "rpe_400m_trans_percent" not in errors


def test_a_scale_that_is_wrong_is_as_wrong_over_every_share() -> None:
    truth = walk(600)
    large = Trajectory(truth.stamps, 1.1 * truth.positions, truth.orientations)
    errors = segment_errors(truth, large, truth.length())
    for share in SHARES:
        value = errors[f"rpe_{share}pct_trans_percent"]
        assert value is not None
        # Of the chord, which is shorter than the path.
        assert (7.0 if share == 1 else 1.0) < value < 10.001
        assert errors[f"rpe_{share}pct_rot_deg_per_m"] == pytest.approx(0.0, abs=1e-9)
    for how, scale_free in (("se3", False), ("sim3", True)):
        record = EstimatorRecord(scale_free)
        record.longest = EstimatorRecord.of(large).longest
        figures = judge(record, truth, alignment="auto" if scale_free else "se3").figures
        assert figures["alignment"] == how
        assert figures["scale"] == pytest.approx(1 / 1.1, rel=1e-6)
        assert figures["ate_sim3_rmse_m"] == pytest.approx(0.0, abs=1e-9)
        assert figures["ate_se3_rmse_m"] > 0.01
        assert figures["ate_rmse_m"] == pytest.approx(figures[f"ate_{how}_rmse_m"], abs=1e-9)


def test_a_stretch_that_nobody_covers_has_no_error() -> None:
    truth = walk(600)
    start = slice(0, 30)
    errors = segment_errors(truth.take(start), truth.take(start), truth.length())
    assert errors["rpe_2pct_trans_percent"] == pytest.approx(0.0, abs=1e-9)
    assert errors["rpe_20pct_trans_percent"] is None


@given(degrees=st.floats(-179.0, 179.0), seed=SEEDS)
@settings(max_examples=30, deadline=None)
def test_a_heading_that_is_off_is_off_by_so_much(degrees: float, seed: int) -> None:
    """Whatever the tilt; and a tilt alone is hardly one."""
    truth = walk(30, seed)
    flat = Trajectory(
        truth.stamps,
        truth.positions,
        Rotation.from_euler("ZYX", np.random.default_rng(seed).uniform(-1, 1, (30, 3))).as_quat(
            scalar_first=True
        ),
    )
    turned = Rotation.from_euler("z", degrees, degrees=True) * flat.rotations()
    estimate = Trajectory(truth.stamps, truth.positions, turned.as_quat(scalar_first=True))
    error = absolute_errors(flat, estimate)["heading_rmse_deg"]
    assert error == pytest.approx(abs(degrees), abs=1e-6)
    rolled = flat.rotations() * Rotation.from_euler("x", degrees, degrees=True)
    estimate = Trajectory(truth.stamps, truth.positions, rolled.as_quat(scalar_first=True))
    assert absolute_errors(flat, estimate)["heading_rmse_deg"] < 1e-6
