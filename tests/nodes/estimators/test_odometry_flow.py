"""Corners followed by optical flow, and back."""

from __future__ import annotations

import numpy as np

from nodes.estimators.images import inside
from nodes.estimators.monocular_odometry.geometry import new_corners
from nodes.estimators.optical_flow import follow_both_ways
from tests.nodes.estimators.monocular_odometry.world import FLAT, INFO, look, pose

HERE, THERE = look(pose(), FLAT), look(pose(x=0.1), FLAT)
SHIFT = -0.1 / 2.0 * INFO.fx
"""Columns by which the floor moves between the two images."""


def test_corners_are_followed_to_where_the_floor_has_moved() -> None:
    corners = new_corners(HERE, np.empty((0, 2)), 60)
    corners = corners[corners[:, 0] > 40]
    for guess, levels in ((corners, 3), (corners + np.array([SHIFT + 2, 1.0]), 1)):
        followed, good = follow_both_ways(HERE, THERE, corners, guess, 15, levels)
        assert good.mean() > 0.9
        np.testing.assert_allclose(
            followed[good] - corners[good], [[SHIFT, 0]] * good.sum(), atol=0.2
        )


def test_a_corner_that_does_not_come_back_is_not_good() -> None:
    corners = new_corners(HERE, np.empty((0, 2)), 60)
    strange = look(pose(x=5.0, y=3.0), FLAT)
    _, good = follow_both_ways(HERE, strange, corners, corners, 15, 1)
    assert good.mean() < 0.3


def test_the_rim_is_not_inside() -> None:
    pixels = np.array([[3.0, 3.0], [2.9, 3.0], [6.9, 4.0], [7.0, 4.0], [5.0, 5.0]])
    assert inside(pixels, (8, 10), 3).tolist() == [True, False, True, False, False]
