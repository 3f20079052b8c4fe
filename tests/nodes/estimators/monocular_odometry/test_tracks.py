"""Corners: where new ones are found, and what is kept of them."""

from __future__ import annotations

import numpy as np

from nodes.estimators.monocular_odometry.local_map import Tracks
from nodes.estimators.monocular_odometry.views import SPACING, new_corners
from tests.nodes.estimators.monocular_odometry.world import FLAT, look, pose

HERE = look(pose(), FLAT)


def test_tracks_remember_their_views_and_hand_over_landmarks_that_leave() -> None:
    tracks = Tracks(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), 0)
    assert not tracks.known.any()
    tracks.points[:2] = [[0, 0, 1], [0, 0, 2]]
    gone = tracks.keep(np.array([1, 2]))
    assert [(point.tolist(), views) for point, views in gone] == [([0, 0, 1], {0: (1, 2)})]
    tracks.add_view(1, np.array([[3.5, 4.0], [5.5, 6.0]]))
    tracks.add(np.array([[9.0, 9.0]]), 1)
    assert tracks.views == [{0: (3, 4), 1: (3.5, 4)}, {0: (5, 6), 1: (5.5, 6)}, {1: (9, 9)}]
    assert tracks.known.tolist() == [True, False, False]
    tracks.drop(np.array([0]))
    assert tracks.pixels.tolist() == [[5.5, 6], [9, 9]]
    assert len(tracks) == len(tracks.views) == len(tracks.points) == 2


def test_corners_keep_away_from_each_other_and_from_those_that_are_taken() -> None:
    some = new_corners(HERE, np.empty((0, 2)), 40)
    more = new_corners(HERE, some, 40)
    together = np.concatenate([some, more])
    gaps = np.linalg.norm(together[:, None] - together, axis=2) + 99 * np.eye(len(together))
    assert gaps.min() > SPACING - 1
    assert len(some) == 40
    assert new_corners(np.zeros_like(HERE), some, 40).shape == (0, 2)
