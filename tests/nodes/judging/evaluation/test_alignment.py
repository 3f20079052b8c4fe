"""Estimates get into the truth's time, frame and scale, as evo gets them there."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.alignment import AlignmentMethod, align, umeyama
from nodes.judging.evaluation.metrics import absolute_errors
from nodes.trajectory import Trajectory, associate
from tests.nodes.trajectory.samples import angle, as_evo, moved, noisy, walk

SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("how", ["origin", "se3", "sim3"])
@given(seed=SEEDS, n=st.integers(20, 60))
@settings(max_examples=10, deadline=None)
def test_alignments_are_evos(how: AlignmentMethod, seed: int, n: int) -> None:
    truth = walk(n, seed)
    estimate = noisy(moved(truth, scale=1.7, seed=seed), seed=seed + 1)
    ours = align(estimate, truth, how)
    theirs, reference = as_evo(estimate), as_evo(truth)
    if how == "origin":
        matrix = theirs.align_origin(reference)
        rotation, translation, scale = matrix[:3, :3], matrix[:3, 3], 1.0
    else:
        rotation, translation, scale = theirs.align(reference, correct_scale=how == "sim3")
    assert ours.rotation == pytest.approx(rotation, abs=1e-9)
    assert ours.translation == pytest.approx(translation, abs=1e-9)
    assert ours.scale == pytest.approx(scale, abs=1e-9)
    assert ours.trajectory.positions == pytest.approx(theirs.positions_xyz, abs=1e-9)
    poses = np.array(theirs.poses_se3)
    assert angle(ours.trajectory, Trajectory.from_matrices(truth.stamps, poses)) < 1e-9


@pytest.mark.parametrize(("how", "scale"), [("origin", 1.0), ("se3", 1.0), ("sim3", 0.4)])
def test_an_estimate_that_is_the_truth_in_another_frame_has_no_error(
    how: AlignmentMethod, scale: float
) -> None:
    truth = walk()
    aligned = align(moved(truth, scale), truth, how)
    assert aligned.scale == pytest.approx(1 / scale)
    error = absolute_errors(truth, aligned.trajectory)
    assert error["ate_max_m"] < 1e-9
    assert error["rot_rmse_deg"] < 1e-9


def test_without_alignment_the_estimate_stays_as_it_is() -> None:
    truth = walk()
    estimate = noisy(truth)
    aligned = align(estimate, truth, "none")
    assert aligned.trajectory is estimate
    assert (aligned.rotation == np.eye(3)).all()
    assert (aligned.translation.tolist(), aligned.scale) == ([0.0, 0.0, 0.0], 1.0)


def test_a_mirror_image_is_not_turned_into_the_truth() -> None:
    """The rotation stays one even where a reflection would fit better."""
    points = walk(50).positions
    mirrored = points * [1.0, 1.0, -1.0]
    rotation, _, _ = umeyama(mirrored, points, with_scale=False)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    theirs, _, _ = umeyama_alignment(mirrored.T, points.T)
    assert rotation == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.3, -0.5, 0.8], [0.0, 0.0, 0.0]])
def test_a_straight_flight_cannot_be_aligned_by_its_positions(direction: list[float]) -> None:
    truth = walk()
    straight = np.outer(np.linspace(0.0, 5.0, len(truth)), direction)
    line = Trajectory(truth.stamps, straight, truth.orientations)
    spread = 5.0 / np.sqrt(12.0) * np.linalg.norm(direction)  # of points evenly on a line
    with pytest.raises(ValueError, match=f"found 300 with spreads .* and {spread:.2g}"):
        align(truth, line, "sim3")
    for pair in ((truth, line), (line, truth), (line, line)):
        with pytest.raises(ValueError, match=r"expected positions that do not all lie on one line"):
            align(*pair, "se3")
    assert align(line, truth, "origin").scale == 1.0


def test_the_truth_is_interpolated_at_the_estimates_stamps() -> None:
    truth = walk(11)
    stamps = np.array([-1, 0, 25_000_000, 500_000_000, 500_000_001])
    estimate = Trajectory(stamps, np.zeros((5, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)))
    at, kept = associate(truth, estimate)
    assert at.stamps.tolist() == kept.stamps.tolist() == [0, 25_000_000, 500_000_000]
    assert at.positions[0] == pytest.approx(truth.positions[0])
    assert at.positions[1] == pytest.approx(truth.positions[:2].mean(axis=0))
    assert (at.positions[[0, 2]] == truth.positions[[0, 10]]).all()


def test_no_time_in_common_is_an_error_that_names_both_times() -> None:
    truth, later = walk(5), walk(5, start=1_000_000_000)
    with pytest.raises(ValueError, match=r"truth from 0 to 200000000 ns .* from 1000000000 to"):
        associate(truth, later)
    with pytest.raises(ValueError, match=r"ns: one is Unix time, the other counts from a run's"):
        associate(truth, walk(5, start=1_403_636_579_758_555_392))
    seconds = Trajectory(np.array([1, 2]), np.zeros((2, 3)), walk(2).orientations)
    with pytest.raises(ValueError, match="ns: is one in seconds and the other in nanoseconds"):
        associate(walk(2, start=10**9), seconds)


@pytest.mark.parametrize("degrees", [0.0, 25.0, 180.0, -90.0])
def test_heading_and_translation_are_aligned_and_nothing_else(degrees: float) -> None:
    truth = walk()
    turn = Rotation.from_euler("z", degrees, degrees=True)
    tilt = Rotation.from_euler("x", 2.0, degrees=True)
    frame = turn * tilt
    estimate = Trajectory(
        truth.stamps,
        frame.apply(truth.positions.copy()) + np.array([1.0, 2.0, 3.0]),
        (frame * truth.rotations()).as_quat(scalar_first=True),
    )
    aligned = align(estimate, truth, "posyaw")
    assert aligned.rotation[2].tolist() == [0.0, 0.0, 1.0]
    # No heading fits better.
    least = absolute_errors(truth, aligned.trajectory)["ate_rmse_m"]
    for beside in (-0.5, 0.5):
        other = Rotation.from_euler("z", beside, degrees=True)
        positions = other.apply(aligned.trajectory.positions.copy())
        positions += (truth.positions - positions).mean(axis=0)
        assert np.sqrt(((positions - truth.positions) ** 2).sum(axis=1).mean()) > least
    assert angle(aligned.trajectory, truth) == pytest.approx(np.radians(2.0), rel=0.2)


def test_one_pose_is_enough_for_heading_and_translation() -> None:
    truth = walk()
    turn = Rotation.from_euler("z", 70, degrees=True)
    estimate = Trajectory(
        truth.stamps,
        turn.apply(truth.positions.copy()) + np.array([5.0, 0.0, 0.0]),
        (turn * truth.rotations()).as_quat(scalar_first=True),
    )
    aligned = align(estimate, truth, "posyaw", 1)
    assert absolute_errors(truth, aligned.trajectory)["ate_max_m"] < 1e-9


@pytest.mark.parametrize("method", ["origin", "posyaw", "se3", "sim3"])
@pytest.mark.parametrize("first", [100, 4.95])
def test_an_alignment_of_the_first_poses_is_evos(method: AlignmentMethod, first: float) -> None:
    """100 poses, or 4.95 s of them at 20 Hz."""
    truth = walk(start=10**18)
    estimate = noisy(moved(truth), seed=3)
    aligned = align(estimate, truth, method, first)
    beginning = align(estimate.take(slice(100)), truth.take(slice(100)), method)
    assert aligned.rotation.tolist() == beginning.rotation.tolist()
    assert len(aligned.trajectory) == len(truth)
    if method in {"se3", "sim3"}:
        theirs = as_evo(estimate)
        theirs.align(as_evo(truth), correct_scale=method == "sim3", n=100)
        assert aligned.trajectory.positions == pytest.approx(theirs.positions_xyz, abs=1e-9)


@pytest.mark.parametrize("method", ["origin", "posyaw", "se3", "sim3"])
def test_a_flight_of_millimetres_is_aligned_as_any_other(method: AlignmentMethod) -> None:
    walked = walk(30)
    small = Trajectory(walked.stamps, 1e-3 * walked.positions, walked.orientations)
    turn = Rotation.from_euler("z", 70, degrees=True)
    estimate = Trajectory(
        small.stamps,
        turn.apply(small.positions.copy()),
        (turn * small.rotations()).as_quat(scalar_first=True),
    )
    aligned = align(estimate, small, method)
    assert absolute_errors(small, aligned.trajectory)["ate_max_m"] < 1e-9


def test_a_half_turn_about_the_horizon_has_any_heading() -> None:
    truth = Trajectory(np.array([0]), np.ones((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    for over in ([0.0, 1.0, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0]):
        estimate = Trajectory(truth.stamps, np.zeros((1, 3)), np.array([over]))
        aligned = align(estimate, truth, "posyaw")
        assert aligned.rotation.tolist() == np.eye(3).tolist()
        assert aligned.translation.tolist() == [1.0, 1.0, 1.0]
    for degrees in (90.0, 180.0):  # and one about the vertical has its own
        turn = Rotation.from_euler("z", degrees, degrees=True)
        estimate = Trajectory(
            truth.stamps, truth.positions, turn.inv().as_quat(scalar_first=True)[None]
        )
        aligned = align(estimate, truth, "posyaw")
        assert aligned.rotation == pytest.approx(turn.as_matrix(), abs=1e-12)


def test_heading_needs_positions_beside_the_vertical() -> None:
    truth = walk(20)
    upright = Trajectory(
        truth.stamps, np.outer(np.arange(20.0), [0.0, 0.0, 1.0]), truth.orientations
    )
    with pytest.raises(ValueError, match="expected positions that differ beside their height"):
        align(upright, truth, "posyaw")
