"""Orientations that are none of the truth's body are found by positions that fit."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.alignment import AlignmentMethod
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.orientations import examine
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory
from tests.nodes.trajectory.samples import moved, noisy, walk

TRUTH = walk(400)


def oriented(rotations: Rotation, trajectory: Trajectory = TRUTH) -> Trajectory:
    """Return a trajectory with other orientations."""
    quaternions = rotations.as_quat(scalar_first=True)
    return Trajectory(trajectory.stamps, trajectory.positions, quaternions)


@given(seed=st.integers(0, 2**32 - 1), degrees=st.floats(6.0, 179.0), scale=st.floats(0.2, 5.0))
@settings(max_examples=30, deadline=None)
def test_a_constant_turn_between_bodies_is_found(seed: int, degrees: float, scale: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    estimate = moved(oriented(TRUTH.rotations() * turn.inv()), scale, seed)
    orientations = examine(TRUTH, estimate)
    assert orientations is not None
    assert orientations.kind == "turned"
    assert orientations.degrees == pytest.approx(degrees)
    assert orientations.spread < 1e-6
    rotation = Rotation.from_quat(orientations.turn, scalar_first=True)
    assert (rotation * turn).magnitude() < 1e-9  # from its body to the truth's


@pytest.mark.parametrize(
    ("vector", "text"),
    [
        ([180, 0, 0], "180.0° about x"), ([0, -90, 0], "90.0° about -y"),
        ([0, 0, 90], "90.0° about z"), ([120 / 3**0.5] * 3, "120.0° about (0.58, 0.58, 0.58)"),
        ([-10, 0.13, 0], "10.0° about -x"), ([-10, 0.3, 0.5], "10.0° about (-1.00, 0.03, 0.05)"),
    ],
)  # fmt: skip
def test_a_turn_is_named_by_its_axis(vector: list[float], text: str) -> None:
    """Within a degree of one; of a half turn the sign tells nothing."""
    turn = Rotation.from_rotvec(np.radians(vector))
    orientations = examine(TRUTH, oriented(TRUTH.rotations() * turn))
    assert orientations is not None
    assert f"its body is turned by {text} against the truth's" in orientations.text()


def swings(degrees: float, period: int = 2) -> Rotation:
    """Return rotations about z, to and fro by so many degrees in so many poses."""
    signs = np.where(np.arange(len(TRUTH)) % period < period // 2, 1.0, -1.0)
    return about("z", degrees * signs[:, None])


def about(axis: str, degrees: float | np.ndarray) -> Rotation:
    """Return the rotation about an axis, or rotations by degrees of shape (n, 1)."""
    return Rotation.from_euler(axis, degrees, degrees=True)


@pytest.mark.parametrize(
    ("true", "given", "kind"),
    [
        # A constant turn is told from 5° on, and from three times of what is beside it.
        (1, swings(1) * about("x", 4.5), "same"),
        (1, swings(1) * about("x", 5.5), "turned"),
        (1, swings(1) * swings(3, 4) * about("z", 10), "turned"),
        (1, swings(1) * swings(3.6, 4) * about("z", 10), "same"),
        # What swings by 30° beside the body is none of it, unless the body swings by twice that.
        (1, swings(1) * swings(29.5, 4), "same"),
        (1, swings(1) * swings(30.5, 4), "other"),
        (64, swings(64) * swings(31, 4), "same"),
        (64, swings(64) * swings(33, 4), "other"),
        # What swings by 10° beside a truth that never does shows that the truth has none.
        (0, swings(9.5), "same"),
        (0, swings(10.5), "truth without"),
        (1, swings(0), "estimate without"),
        # Inverted is what fits four times better if inverted back; below 2° nothing is told.
        (1.2, swings(-1.2), "inverse"),
        (0.9, swings(-0.9), "same"),
        (10, swings(-10) * swings(4, 4), "inverse"),
        (10, swings(-10) * swings(8, 4), "same"),
    ],
)
def test_limits_of_what_orientations_tell(true: float, given: Rotation, kind: str) -> None:
    orientations = examine(oriented(swings(true)), oriented(given))
    assert orientations is not None
    assert orientations.kind == kind


@pytest.mark.parametrize(("share", "tells"), [(0.08, True), (0.12, False)])
def test_positions_off_by_a_tenth_of_their_extent_tell_nothing(share: float, tells: bool) -> None:
    """Of the second of their three extents."""
    centred = TRUTH.positions - TRUTH.positions.mean(axis=0)
    extent = np.linalg.svd(centred, compute_uv=False)[1] / np.sqrt(len(centred))
    off = np.where(np.arange(len(TRUTH)) % 2, share, -share)[:, None] * extent * [0.0, 0.0, 1.0]
    estimate = Trajectory(TRUTH.stamps, TRUTH.positions + off, TRUTH.orientations)
    assert (examine(TRUTH, estimate) is not None) == tells


def test_an_estimate_with_noise_and_drift_is_of_the_same_body() -> None:
    orientations = examine(TRUTH, moved(noisy(TRUTH)))
    assert orientations is not None
    assert (orientations.kind, orientations.text()) == ("same", "")


SENT = moved(TRUTH)
ODD = {
    "inverse": oriented(SENT.rotations().inv(), SENT),
    "order": Trajectory(SENT.stamps, SENT.positions, np.roll(SENT.orientations, 1, axis=1)),
    "estimate without": oriented(Rotation.identity(len(TRUTH)), SENT),
    "other": oriented(Rotation.random(len(TRUTH), rng=np.random.default_rng(1)), SENT),
}


@pytest.mark.parametrize("kind", ODD)
def test_figures_of_orientations_that_are_none_are_left_out(kind: str) -> None:
    record = EstimatorRecord.of(ODD[kind])
    judgement = judge(record, TRUTH, alignment="se3")
    assert judgement.orientations is not None
    assert judgement.orientations.kind == kind
    assert judgement.figures["ate_rmse_m"] < 1e-9
    for name in ("rot_rmse_deg", "heading_rmse_deg", "rpe_1m_trans_percent", "end_error_percent"):
        assert name not in judgement.figures
    assert judgement.figures["why_no_rotations"] in judgement.note


def test_a_truth_of_positions_only_judges_positions_only() -> None:
    truth = oriented(Rotation.identity(len(TRUTH)))
    judgement = judge(EstimatorRecord.of(noisy(TRUTH)), truth, alignment="se3")
    assert "rot_rmse_deg" not in judgement.figures
    assert "the truth has no orientations" in judgement.note
    assert judgement.figures["ate_rmse_m"] < 0.1


def test_nothing_is_said_where_positions_do_not_fit_or_lie_on_a_line() -> None:
    assert examine(TRUTH, walk(400, seed=5)) is None
    line = Trajectory(TRUTH.stamps, np.outer(np.arange(400.0), [1.0, 0.0, 0.0]), TRUTH.orientations)
    assert examine(line, line) is None


def test_a_vehicle_that_never_turns_is_judged_as_ever() -> None:
    still = Trajectory(TRUTH.stamps, TRUTH.positions, np.tile([1.0, 0.0, 0.0, 0.0], (400, 1)))
    shakes = Rotation.from_rotvec(np.random.default_rng(3).normal(0.0, 0.001, (len(TRUTH), 3)))
    judgement = judge(EstimatorRecord.of(oriented(shakes)), still, alignment="se3")
    assert judgement.figures["rot_rmse_deg"] == pytest.approx(0.1, rel=0.1)
    assert judgement.note == ""


def test_an_estimate_that_rotates_a_little_beside_a_truth_that_never_does_is_wrong() -> None:
    still = oriented(Rotation.identity(len(TRUTH)))
    angles = 5.0 * np.sin(np.arange(len(TRUTH)) / 20)
    turns = Rotation.from_euler("z", angles[:, None], degrees=True)
    judgement = judge(EstimatorRecord.of(oriented(turns)), still, alignment="se3")
    assert judgement.figures["rot_rmse_deg"] == pytest.approx(5.0 / np.sqrt(2.0), rel=0.1)


def test_neither_has_orientations() -> None:
    plain = Rotation.identity(len(TRUTH))
    truth, estimate = oriented(plain), oriented(plain, moved(noisy(TRUTH)))
    judgement = judge(EstimatorRecord.of(estimate), truth, alignment="se3")
    assert judgement.figures["orientations"] == "truth without"
    assert "rot_rmse_deg" not in judgement.figures
    assert "rpe_1m_trans_percent" not in judgement.figures


@pytest.mark.parametrize(("alignment", "first"), [("origin", None), ("posyaw", 1)])
def test_a_first_pose_without_orientation_aligns_nothing(
    alignment: AlignmentMethod, first: int | None
) -> None:
    for truth, estimate in ((TRUTH, ODD["estimate without"]), (ODD["estimate without"], TRUTH)):
        judgement = judge(
            EstimatorRecord.of(estimate), truth, alignment=alignment, align_first=first
        )
        assert f"expected orientations for {alignment}, found none" in judgement.figures["why"]
    record = EstimatorRecord.of(SENT, "odom")
    judgement = judge(record, oriented(Rotation.identity(len(TRUTH))))
    assert judgement.figures["alignment"] == "se3"


@pytest.mark.parametrize("kind", ODD)
def test_a_final_trajectory_is_examined_too(kind: str) -> None:
    record = EstimatorRecord.of(SENT)
    record.final = ODD[kind]
    judgement = judge(record, TRUTH, alignment="se3")
    assert "rot_rmse_deg" in judgement.figures
    assert "final_rot_rmse_deg" not in judgement.figures
    assert "after loop closures: " in judgement.note


def test_a_turn_is_told_only_where_it_is_constant() -> None:
    turn = Rotation.from_euler("x", 10.0, degrees=True)
    shakes = Rotation.from_rotvec(np.random.default_rng(3).normal(0.0, 0.02, (len(TRUTH), 3)))
    orientations = examine(TRUTH, oriented(TRUTH.rotations() * turn * shakes))
    assert orientations is not None
    assert orientations.kind == "turned"
    figures = judge(EstimatorRecord.of(oriented(TRUTH.rotations() * turn * shakes)), TRUTH).figures
    assert figures["orientations"] == "turned"
    assert figures["body_rotation_deg"] == pytest.approx(orientations.degrees)
    assert figures["body_rotation_spread_deg"] == pytest.approx(orientations.spread)
    wide = Rotation.from_rotvec(np.random.default_rng(3).normal(0.0, 0.08, (len(TRUTH), 3)))
    orientations = examine(TRUTH, oriented(TRUTH.rotations() * turn * wide))
    assert orientations is not None
    assert orientations.kind == "same"


def test_a_tilted_vertical_is_told_where_it_has_to_be_the_truths() -> None:
    turn = Rotation.from_euler("x", 180.0, degrees=True)
    estimate = Trajectory(
        TRUTH.stamps,
        turn.apply(TRUTH.positions.copy()),
        (turn * TRUTH.rotations()).as_quat(scalar_first=True),
    )
    record = EstimatorRecord.of(estimate)
    told = judge(record, TRUTH, alignment="posyaw").note
    assert "its vertical is tilted by 180° against the truth's" in told
    assert "vertical" not in judge(record, TRUTH, alignment="se3").note
    assert "vertical" not in judge(EstimatorRecord.of(noisy(TRUTH)), TRUTH, alignment="none").note


def test_a_final_trajectory_is_examined_where_nothing_else_was_sent() -> None:
    record = EstimatorRecord()
    record.final = ODD["inverse"]
    judgement = judge(record, TRUTH, alignment="se3")
    assert "after loop closures: its orientations are inverted" in judgement.note
