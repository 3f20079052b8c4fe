"""Depth images with colours, as points in the world."""

from __future__ import annotations

import numpy as np
import pytest

from tests.nodes.viewers.common.samples import CAMERA, MS, camera_pose, depth, image
from visnav_rerun.entities import ScenePoints


def scene_points(rate: float = 2.0, max_height: float = 9.0) -> ScenePoints:
    return ScenePoints(CAMERA.info, rate, stride=1, max_distance=8.0, max_height=max_height)


def test_points_lie_where_the_camera_saw_them() -> None:
    """Looking north from (10, 20, -1): 2 m ahead is north, right is east, down is down."""
    shown = scene_points()
    assert shown.add(camera_pose(0)) is None
    assert shown.add(depth(0)) is None
    seen = shown.add(image(0))
    assert seen is not None
    assert seen.points[:, 0] == pytest.approx(np.full(48, 12.0))
    # the pixel in the upper left corner: -3.5/4 · 2 m to the right, -2.5/4 · 2 m down
    assert seen.points[0] == pytest.approx([12.0, 20.0 - 1.75, -1.0 - 1.25])
    assert set(map(tuple, seen.colours.tolist())) == {(200, 100, 50)}


def test_what_is_high_above_the_camera_is_left_out() -> None:
    shown = scene_points(max_height=0.5)
    shown.add(camera_pose(0))
    shown.add(depth(0))
    seen = shown.add(image(0))
    assert seen is not None
    assert seen.points[:, 2].min() > -1.5
    assert 0 < len(seen.points) < 48


def test_points_need_one_exposure_and_their_time() -> None:
    shown = scene_points(rate=2.0)
    clouds = []
    for stamp in range(0, 1000 * MS, 100 * MS):
        shown.add(camera_pose(stamp))
        shown.add(depth(stamp))
        assert shown.add(image(stamp + MS)) is None  # another exposure
        clouds.append(shown.add(image(stamp)))
    assert sum(cloud is not None for cloud in clouds) == 2
