"""The cloud keeps one point a cell, and forgets what lay elsewhere."""

from __future__ import annotations

import numpy as np

from nodes.orb_slam3.anchor import Cloud


def test_the_last_point_of_each_cell_stays() -> None:
    cloud = Cloud(cell=0.1)
    assert cloud.points().shape == (0, 3)
    cloud.add(0.0, np.array([[0.01, 0.02, 1.0], [-0.01, 0.02, 1.0]], np.float32))
    cloud.add(0.0, np.array([[0.09, 0.03, 1.05]], np.float32))
    assert len(cloud) == 2
    assert cloud.points().dtype == np.float32
    expected = np.array([[-0.01, 0.02, 1.0], [0.09, 0.03, 1.05]], np.float32)
    np.testing.assert_array_equal(np.sort(cloud.points(), axis=0), expected)


def test_a_map_can_be_forgotten() -> None:
    cloud = Cloud()
    cloud.add(0.0, np.zeros((1, 3), np.float32))
    cloud.add(7.0, np.ones((1, 3), np.float32))
    cloud.forget(7.0)
    np.testing.assert_array_equal(cloud.points(), np.zeros((1, 3)))
    cloud.forget(8.0)
    assert len(cloud) == 1
