"""Which pictures are shown, and what is made of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from nodes.viewing.images import Surroundings, Thinning, depth_png, jpeg
from tests.nodes.rerun_view.said import CAMERA, MS, camera_pose, depth, image, picture


def test_of_thirty_pictures_a_second_five_are_kept_and_of_one_exposure_all() -> None:
    thinning = Thinning(5.0)
    stamps = [i * 1_000_000_000 // 30 for i in range(60)]
    kept = {
        kind: [s for s in stamps if thinning.picture(kind, "drone/camera", "optical", s)]
        for kind in ("Image", "DepthImage")
    }
    assert len(kept["Image"]) == 10
    assert kept["Image"] == kept["DepthImage"]
    assert [s for s in stamps if thinning.belongs("optical", s)] == kept["Image"]
    assert not thinning.belongs("another", stamps[0])


def test_without_a_rate_there_are_no_pictures() -> None:
    assert not Thinning(0.0).picture("Image", "a", "a", 0)


def test_red_stays_red() -> None:
    data = np.zeros((16, 16, 3), np.uint8)
    data[..., 0] = 220
    back = picture(jpeg(data, 90), cv2.IMREAD_COLOR_RGB)
    assert np.abs(back.astype(int) - data).max() < 8


def test_depth_is_kept_to_the_centimetre_and_nothing_is_nought() -> None:
    data = np.array([[1.234, np.inf], [0.0, 700.0]], np.float32)
    back = picture(depth_png(data), cv2.IMREAD_UNCHANGED)
    assert back.tolist() == [[123, 0], [0, 0]]


def surroundings(rate: float = 2.0, above: float = 9.0) -> Surroundings:
    return Surroundings(CAMERA.info, rate, stride=1, reach=8.0, above=above)


def test_points_lie_where_the_camera_saw_them() -> None:
    """Looking north from (10, 20, -1): 2 m ahead is north, right is east, down is down."""
    shown = surroundings()
    assert shown.take(camera_pose(0)) is None
    assert shown.take(depth(0)) is None
    seen = shown.take(image(0))
    assert seen is not None
    assert seen.points[:, 0] == pytest.approx(np.full(48, 12.0))
    # the pixel in the upper left corner: -3.5/4 · 2 m to the right, -2.5/4 · 2 m down
    assert seen.points[0] == pytest.approx([12.0, 20.0 - 1.75, -1.0 - 1.25])
    assert set(map(tuple, seen.colours.tolist())) == {(200, 100, 50)}


def test_what_is_high_above_the_camera_is_left_out() -> None:
    shown = surroundings(above=0.5)
    shown.take(camera_pose(0))
    shown.take(depth(0))
    seen = shown.take(image(0))
    assert seen is not None
    assert seen.points[:, 2].min() > -1.5
    assert 0 < len(seen.points) < 48


def test_points_need_one_exposure_and_their_time() -> None:
    shown = surroundings(rate=2.0)
    found = []
    for stamp in range(0, 1000 * MS, 100 * MS):
        shown.take(camera_pose(stamp))
        shown.take(depth(stamp))
        assert shown.take(image(stamp + MS)) is None  # another exposure
        found.append(shown.take(image(stamp)))
    assert sum(each is not None for each in found) == 2
