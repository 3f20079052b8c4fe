"""Trajectories: what they take, what they refuse, and the poses between the poses.

Recent poses are forgotten when they are old, and never guessed.
"""

from __future__ import annotations

import io
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from nodes.trajectory import HISTORY, PoseRows, RecentPoses, Trajectory
from tests.nodes.trajectory.samples import angle, as_evo, walk

SEEDS = st.integers(0, 2**32 - 1)
ONE = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))


def test_arrays_are_copied_checked_and_read_only() -> None:
    stamps, positions = np.array([0, 1, 2]), np.zeros((3, 3))
    trajectory = Trajectory(stamps, positions, ONE)
    positions[0] = 9.0
    stamps[0] = -9
    assert trajectory.positions[0].tolist() == [0.0, 0.0, 0.0]
    assert trajectory.stamps.dtype == np.int64
    assert trajectory.stamps[0] == 0
    for array in (trajectory.stamps, trajectory.positions, trajectory.orientations):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(
    ("stamps", "positions", "orientations", "message"),
    [
        ([], np.zeros((0, 3)), np.zeros((0, 4)), r"stamps: expected whole nanoseconds"),
        (np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 4)), r"stamps: expected one or more"),
        ([0.0, 0.1, 0.2], np.zeros((3, 3)), ONE, r"whole nanoseconds, found float64"),
        ([[0, 1, 2]], np.zeros((3, 3)), ONE, r"in a row, found shape \(1, 3\)"),
        ([0, 5, 5], np.zeros((3, 3)), ONE, r"row 2: expected a stamp above 5 ns, found 5 ns"),
        ([0, 5, 4], np.zeros((3, 3)), ONE, r"row 2: expected a stamp above 5 ns, found 4 ns"),
        ([0, 1, 2], np.zeros((2, 3)), ONE, r"positions: expected shape \(3, 3\), .* \(2, 3\)"),
        ([0, 1, 2], np.zeros((3, 3)), ONE[:, :3], r"orientations: expected shape \(3, 4\)"),
        ([0, 1, 2], np.full((3, 3), np.nan), ONE, r"row 0: positions: expected finite numbers"),
        ([0, 1, 2], np.zeros((3, 3)), 2 * ONE, r"row 0: expected a quaternion of length 1"),
        ([0, 1, 2], np.zeros((3, 3)), 0 * ONE, r"row 0: .* found \[0.0, .*\] of length 0"),
    ],
)
def test_what_is_no_trajectory_is_refused(
    stamps: Any, positions: Any, orientations: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Trajectory(stamps, positions, orientations)


def test_quaternions_of_few_decimals_are_made_unit() -> None:
    rough = np.round(walk(50).orientations, 4)
    trajectory = Trajectory(np.arange(50), np.zeros((50, 3)), rough)
    assert np.linalg.norm(trajectory.orientations, axis=1) == pytest.approx(1.0, abs=1e-15)


def test_unit_quaternions_keep_their_bits() -> None:
    path = walk()
    assert (path.take(slice(5, None)).orientations == path.orientations[5:]).all()


def test_length_and_distances_are_evos() -> None:
    path = walk()
    assert path.length() == pytest.approx(as_evo(path).path_length)
    assert path.distances() == pytest.approx(as_evo(path).distances)
    assert walk(1).length() == 0.0


@pytest.mark.slow
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_matrices_and_back(seed: int) -> None:
    path = walk(30, seed)
    matrices = path.matrices()
    assert matrices == pytest.approx(np.array(as_evo(path).poses_se3), abs=1e-12)
    back = Trajectory.from_matrices(path.stamps, matrices)
    assert back.positions == pytest.approx(path.positions, abs=1e-15)
    assert angle(path, back) < 1e-9


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "row 0: expected a rotation matrix"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "row 0: expected a rotation matrix"),
        (np.full((4, 4), np.nan), "row 0: expected a rotation matrix"),
        (np.eye(3), r"expected shape \(n, 4, 4\), found \(1, 3, 3\)"),
    ],
)
def test_what_is_no_transform_is_refused(matrix: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Trajectory.from_matrices(np.array([0]), matrix[None])


@given(seed=SEEDS, data=st.data())
@settings(max_examples=30, deadline=None)
def test_poses_between_poses_are_evos(seed: int, data: st.DataObject) -> None:
    path = walk(20, seed)
    end = int(path.stamps[-1])
    stamps = np.array(sorted(data.draw(st.sets(st.integers(0, end), min_size=1, max_size=30))))
    ours, theirs = path.at(stamps), as_evo(path).interpolate(stamps / 1e9)
    assert isinstance(theirs, PoseTrajectory3D)
    assert ours.positions == pytest.approx(theirs.positions_xyz, abs=1e-9)
    other = Trajectory(stamps, theirs.positions_xyz, theirs.orientations_quat_wxyz)
    assert angle(ours, other) < 1e-7  # evo leaves angles below that out


def test_a_stamp_that_there_is_gives_that_very_row() -> None:
    path = walk(50)
    rows = path.at(path.stamps[[0, 7, 8, 49]])
    assert (rows.positions == path.positions[[0, 7, 8, 49]]).all()
    assert (rows.orientations == path.orientations[[0, 7, 8, 49]]).all()
    assert walk(1).at(np.array([0])).stamps.tolist() == [0]


def test_interpolation_takes_the_shorter_arc_whatever_the_signs_of_the_quaternions() -> None:
    turn = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]]).as_quat(scalar_first=True)
    turn[1] *= -1.0
    path = Trajectory(np.array([0, 100]), np.zeros((2, 3)), turn)
    angles = path.at(np.array([50])).rotations().as_euler("zyx", degrees=True)
    assert angles[0] == pytest.approx([45.0, 0.0, 0.0])


def test_late_stamps_are_told_apart_to_the_nanosecond() -> None:
    """As after fifty years of seconds, where a float would know a quarter of a microsecond."""
    start = 1_700_000_000_000_000_000
    path = Trajectory(np.array([start, start + 10]), np.array([[0.0] * 3, [10.0] * 3]), ONE[:2])
    assert path.at(np.array([start + 3])).positions[0].tolist() == pytest.approx([3.0] * 3)


def test_times_outside_are_an_error_and_can_be_known_before() -> None:
    path = walk(5, start=100)
    stamps = np.array([99, 100, 200_000_100, 200_000_101])
    assert path.covers(stamps).tolist() == [False, True, True, False]
    with pytest.raises(ValueError, match=r"between 100 and 200000100 ns, found 99 ns \(2 such\)"):
        path.at(stamps)


def test_between_poses_far_apart_nothing_is_covered() -> None:
    path = walk(5, start=100)  # every 50 ms
    stamps = np.array([100, 101, 50_000_100])
    assert path.covers(stamps, 50_000_000).tolist() == [True, True, True]
    assert path.covers(stamps, 49_999_999).tolist() == [True, False, True]
    assert path.take(slice(1)).covers(stamps, 1).tolist() == [True, False, False]


def test_rows_come_in_any_order_and_the_last_word_on_a_stamp_holds() -> None:
    rows = PoseRows()
    for stamp, x in ((10, 1.0), (0, 0.0), (20, 9.0), (20, 2.0)):
        rows.add(stamp, (x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    trajectory = rows.trajectory()
    assert trajectory.stamps.tolist() == [0, 10, 20]
    assert trajectory.positions[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert trajectory.seconds == 2e-8


def test_no_rows_are_no_trajectory() -> None:
    with pytest.raises(ValueError, match="expected one or more"):
        PoseRows().trajectory()


@pytest.mark.parametrize("full_after", [10**9, 2, 0])
def test_many_rows_wait_in_a_file_or_in_memory_if_the_disk_is_full(
    monkeypatch: pytest.MonkeyPatch, full_after: int
) -> None:
    class Disk(io.BytesIO):
        writes = 0

        def write(self, block: Any, /) -> int:
            self.writes += 1
            if self.writes > full_after:
                raise OSError(28, "No space left on device")
            return super().write(block)

    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: Disk())
    rows = PoseRows()
    n = 5000
    for k in range(n):
        rows.add(k, (float(k), 0.0, -1.0), (1.0, 0.0, 0.0, 0.0))
    assert len(rows) == n
    for _ in range(2):
        path = rows.trajectory()
        assert path.stamps.tolist() == list(range(n))
        assert path.positions[:, 0].tolist() == [float(k) for k in range(n)]


@pytest.mark.slow
@given(st.integers(0, 900_000_000))
def test_poses_between_two_are_those_of_a_trajectory(stamp: int) -> None:
    truth = walk(10)
    recent = RecentPoses()
    for row in np.random.default_rng(0).permutation(len(truth)).tolist():  # any order will do
        position, orientation = truth.positions[row].tolist(), truth.orientations[row].tolist()
        recent.add(int(truth.stamps[row]), tuple(position), tuple(orientation))
    first, last = int(truth.stamps[0]), int(truth.stamps[-1])
    pose = recent.at(stamp)
    if not first <= stamp <= last:
        assert pose is None
        return
    assert pose is not None
    expected = truth.at(np.array([stamp]))
    turn = Rotation.from_quat(pose[1], scalar_first=True).inv() * expected.rotations()[0]
    assert pose[0] == pytest.approx(expected.positions[0], abs=1e-12)
    assert turn.magnitude() < 1e-9


def test_a_stamp_that_is_kept_gives_its_very_pose_and_the_newest_of_several() -> None:
    recent = RecentPoses()
    recent.add(5, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    recent.add(5, (2.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
    assert recent.at(5) == ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))


def test_what_is_older_than_the_history_is_forgotten() -> None:
    recent, step = RecentPoses(), HISTORY // 2
    assert recent.at(0) is None
    for stamp in range(0, 20 * step, step):
        recent.add(stamp, (float(stamp), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    first = 17 * step
    assert recent.at(first - 1) is None
    assert recent.at(first) == ((float(first), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
