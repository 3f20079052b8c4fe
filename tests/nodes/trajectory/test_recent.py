"""Recent poses: looked up between two of them, forgotten when they are old, never guessed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nodes.trajectory import RecentPoses
from nodes.trajectory.trajectory import HISTORY
from tests.nodes.trajectory.samples import walk


@given(st.integers(0, 900_000_000))
def test_poses_between_two_are_those_of_a_trajectory(stamp: int) -> None:
    truth = walk(10)
    recent = RecentPoses()
    for row in np.random.default_rng(0).permutation(len(truth)).tolist():  # any order will do
        position, orientation = truth.positions[row].tolist(), truth.orientations[row].tolist()
        recent.add(int(truth.stamps[row]), tuple(position), tuple(orientation))
    first, last = int(truth.stamps[0]), int(truth.stamps[-1])
    found = recent.at(stamp)
    if not first <= stamp <= last:
        assert found is None
        return
    assert found is not None
    expected = truth.at(np.array([stamp]))
    turn = Rotation.from_quat(found[1], scalar_first=True).inv() * expected.rotations()[0]
    assert found[0] == pytest.approx(expected.positions[0], abs=1e-12)
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
