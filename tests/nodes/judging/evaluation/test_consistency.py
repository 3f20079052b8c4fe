"""Velocities and covariances are held against the truth, and wrong ones are found out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from events import PoseEstimate
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.metrics import consistency, positive_definite
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory
from tests.nodes.trajectory.samples import walk

Floats = npt.NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)
MS = 1_000_000


def covariance(seed: int) -> Floats:
    """Return some covariance of centimetres and degrees, with correlations."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(6, 6)) * np.repeat([[0.05], [0.02]], 3, axis=0)
    return np.asarray(root @ root.T + np.diag([1e-4] * 3 + [1e-5] * 3))


def drawn(truth: Trajectory, p: Floats, seed: int) -> Trajectory:
    """Return poses whose errors have a covariance."""
    errors = np.random.default_rng(seed).multivariate_normal(np.zeros(6), p, len(truth))
    turns = Rotation.from_rotvec(errors[:, 3:]) * truth.rotations()
    positions = truth.positions + errors[:, :3]
    return Trajectory(truth.stamps, positions, turns.as_quat(scalar_first=True))


def repeated(p: Floats, count: int) -> Floats:
    return np.tile(p, (count, 1, 1))


@pytest.mark.slow
@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_a_true_covariance_is_consistent(seed: int) -> None:
    truth, p = walk(3000), covariance(seed)
    figures = consistency(truth, drawn(truth, p, seed + 1), repeated(p, 3000))
    assert figures["covariance_invalid"] == 0
    assert figures["nees_position"] == pytest.approx(3.0, abs=0.35)
    assert figures["nees_pose"] == pytest.approx(6.0, abs=0.5)
    assert figures["nees_position_inside_percent"] == pytest.approx(95.0, abs=2.5)
    assert figures["nees_pose_inside_percent"] == pytest.approx(95.0, abs=2.5)


@pytest.mark.parametrize(
    ("nees", "position", "pose", "three_sigma"),
    [
        (0.215, 0, 0, 100), (0.217, 100, 0, 100), (0.23, 100, 0, 100), (0.24, 100, 100, 100),
        (9.34, 100, 100, 100), (9.36, 0, 100, 100), (13.4, 0, 100, 100), (13.5, 0, 0, 100),
        (14.1, 0, 0, 100), (14.2, 0, 0, 0),
    ],
)  # fmt: skip
def test_one_pose_is_the_quadratic_form_and_the_bounds_are_those_of_chi_squared(
    nees: float, position: int, pose: int, three_sigma: int
) -> None:
    """Beside the position, the orientation is off by one standard deviation."""
    truth = walk(4)
    moved = truth.positions + np.array([0.0, 0.2 * np.sqrt(nees), 0.0])
    turned = Rotation.from_rotvec([0.5, 0.0, 0.0]) * truth.rotations()
    estimate = Trajectory(truth.stamps, moved, turned.as_quat(scalar_first=True))
    p = repeated(np.diag([0.01, 0.04, 0.09, 0.25, 1.0, 1.0]), 4)
    figures = consistency(truth, estimate, p)
    assert figures == {
        "covariance_invalid": 0,
        "nees_position": pytest.approx(nees),
        "nees_position_inside_percent": position,
        "within_3_sigma_percent": three_sigma,
        "nees_pose": pytest.approx(nees + 1.0),
        "nees_pose_inside_percent": pose,
    }


@pytest.mark.parametrize(("factor", "mean"), [(0.01, 300.0), (100.0, 0.03)])
def test_overconfidence_and_caution_show(factor: float, mean: float) -> None:
    truth, p = walk(2000), covariance(4)
    figures = consistency(truth, drawn(truth, p, 5), repeated(factor * p, 2000))
    assert figures["nees_position"] == pytest.approx(mean, rel=0.1)
    inside = figures["nees_position_inside_percent"]
    assert inside is not None
    assert inside < 15.0


NONE: dict[str, Callable[[Floats], Floats]] = {
    "zeros": lambda p: 0.0 * p,
    "negative": lambda p: -p,
    "not symmetric": lambda p: p + np.triu(p.diagonal()[:, None] * np.ones((6, 6)), 1),
    "not symmetric by a little": lambda p: p * (1 + 1e-3 * np.triu(np.ones((6, 6)), 1)),
    "not a number": lambda p: p * np.nan,
    "not a number in one place": lambda p: np.where(np.arange(36).reshape(6, 6) == 1, np.nan, p),
    "infinite": lambda p: p * np.inf,
    "certain in one direction": lambda p: p * (np.arange(6) > 0) * (np.arange(6) > 0)[:, None],
    "two of six the same": lambda p: np.diag([0.01] * 6) + 0.01 * np.eye(6)[[1, 0, 2, 3, 4, 5]],
    "singular": lambda p: np.outer(np.ones(6), np.ones(6)) * 1e-4,
    "greater correlation than 1": lambda p: np.eye(6) * 0.01 + 0.02 * (1 - np.eye(6)),
}


@pytest.mark.parametrize("kind", NONE)
def test_what_is_no_covariance_is_counted_and_outside(kind: str) -> None:
    truth, p = walk(400), covariance(1)
    estimate, all_true = drawn(truth, p, 2), repeated(p, 400)
    wrong = all_true.copy()
    wrong[::2] = NONE[kind](p)
    figures = consistency(truth, estimate, wrong)
    assert figures["covariance_invalid"] == 200
    inside = figures["nees_pose_inside_percent"]
    assert inside is not None
    assert inside < 50.0
    assert figures["nees_pose"] == pytest.approx(6.0, abs=1.0)
    figures = consistency(truth, estimate, repeated(NONE[kind](p), 400))
    assert figures["nees_pose"] is None
    assert figures["nees_pose_inside_percent"] == 0.0


@given(seed=SEEDS, scales=st.lists(st.floats(1e-6, 1e3), min_size=6, max_size=6))
@settings(max_examples=50, deadline=None)
def test_a_covariance_is_one_in_any_units(seed: int, scales: list[float]) -> None:
    p = covariance(seed) * np.outer(scales, scales)
    assert positive_definite(p[None]).tolist() == [True]


@pytest.mark.parametrize("count", [4096, 4097, 9000])
def test_of_many_covariances_each_is_checked(count: int) -> None:
    valid = positive_definite(np.eye(6) * np.append(np.ones(count - 1), -1.0)[:, None, None])
    assert (len(valid), valid.sum(), valid[-1]) == (count, count - 1, False)


def moving(
    velocity: Callable[[int, Floats], Floats] | None = None, frame: Rotation | None = None
) -> tuple[EstimatorRecord, Trajectory]:
    """Return the record of an estimator without errors in a frame of its own, and the truth."""
    truth = walk(400)
    turn = Rotation.identity() if frame is None else frame
    true = truth.velocities()
    record = EstimatorRecord()
    orientations = (turn * truth.rotations()).as_quat(scalar_first=True)
    noise = np.random.default_rng(0).normal(0.0, 0.1, (400, 3)) * [1.0, 0.1, 0.01]
    p = np.zeros((6, 6))
    r = turn.as_matrix()
    p[:3, :3], p[3:, 3:] = r @ np.diag([1e-2, 1e-4, 1e-6]) @ r.T, np.eye(3) * 1e-6
    noise[0] = 0.0  # by which it is aligned
    for k, position in enumerate(turn.apply(truth.positions + noise).tolist()):
        said = turn.apply(true[k] if velocity is None else velocity(k, true[k]))
        event = PoseEstimate(
            stamp=int(truth.stamps[k]),
            source="est",
            frame_id="odom",
            position=tuple(position),
            orientation=tuple(orientations[k].tolist()),
            velocity=tuple(said.tolist()),
            covariance=tuple(p.ravel().tolist()),
        )
        record.add(event, event.stamp + MS)
    return record, truth


def test_velocities_and_covariances_turn_with_the_alignment() -> None:
    record, truth = moving(frame=Rotation.from_euler("xyz", [0.1, -0.2, 2.0]))
    figures = judge(record, truth).figures
    assert figures["alignment"] == "origin"
    assert figures["velocity_rmse_m_per_s"] < 1e-9
    assert figures["nees_position"] == pytest.approx(3.0, abs=0.4)


def test_velocities_in_the_bodys_frame_or_of_another_unit_are_wrong() -> None:
    truth = walk(400)
    speed = float(np.linalg.norm(truth.velocities(), axis=1).mean())
    into_body = truth.rotations().inv()
    record, _ = moving(lambda k, v: into_body[k].apply(v))
    assert judge(record, truth).figures["velocity_rmse_m_per_s"] > 0.3 * speed
    record, _ = moving(lambda k, v: 3.6 * v)
    assert judge(record, truth).figures["velocity_rmse_m_per_s"] > 2.5 * speed


def test_who_gives_neither_has_no_such_figures() -> None:
    figures = judge(EstimatorRecord.of(walk(100)), walk(100)).figures
    assert not {name for name in figures if name.startswith(("velocity", "nees", "covariance"))}


def test_a_covariance_given_now_and_then_is_that_of_its_pose() -> None:
    truth = walk(300)
    record = EstimatorRecord()
    for k, (stamp, position, orientation) in enumerate(truth.poses()):
        (x, y, z), (qw, qx, qy, qz) = position, orientation
        given: dict[str, Any] = {}
        if k % 3 == 1:
            p = tuple((np.eye(6) * 0.01).ravel().tolist())
            given = {"covariance": p, "velocity": tuple(truth.velocities()[k].tolist())}
        off = 0.1 if k % 3 == 1 else 5.0
        record.add(
            PoseEstimate(
                stamp=stamp, source="e", frame_id="map",
                position=(x + off, y, z), orientation=(qw, qx, qy, qz), **given,
            ),
            stamp,
        )  # fmt: skip
    figures = judge(record, truth).figures
    assert figures["nees_position"] == pytest.approx(1.0)
    assert figures["velocity_rmse_m_per_s"] < 1e-9


def test_of_a_covariance_lengths_are_scaled_and_angles_are_not() -> None:
    """Of an estimator whose unit is a quarter of a metre, so that Sim(3) scales it by 0.25."""
    truth = walk(300)
    record = EstimatorRecord(scale_free=True)
    noise = np.random.default_rng(1).normal(0.0, 0.02, (300, 3))
    p = np.diag([0.02**2 * 16] * 3 + [1e-4] * 3)
    turns = Rotation.from_rotvec(0.01 * (-1.0) ** np.arange(300)[:, None] * [0.0, 0.0, 1.0])
    orientations = (truth.rotations() * turns).as_quat(scalar_first=True)
    for k, (x, y, z) in enumerate((4 * (truth.positions + noise)).tolist()):
        qw, qx, qy, qz = orientations[k].tolist()
        event = PoseEstimate(
            stamp=int(truth.stamps[k]),
            source="e",
            position=(x, y, z),
            orientation=(qw, qx, qy, qz),
            covariance=tuple(p.ravel().tolist()),
        )
        record.add(event, event.stamp)
    figures = judge(record, truth).figures
    assert figures["scale"] == pytest.approx(0.25, rel=0.02)
    assert figures["nees_position"] == pytest.approx(3.0, abs=0.4)
    assert figures["nees_pose"] == pytest.approx(figures["nees_position"] + 1.0, abs=0.1)
