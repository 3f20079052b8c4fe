"""The first map, against the world that it is of."""

from __future__ import annotations

import numpy as np
import pytest

from events.geometry import inverse
from nodes.estimators.monocular_odometry.initialization import Initialization, InitialMap
from nodes.estimators.monocular_odometry.views import MonocularSettings
from tests.nodes.estimators.monocular_odometry.world import (
    FLAT,
    MATRIX,
    RELIEF,
    STEPPED,
    Floats,
    Grey,
    Tile,
    look,
    pose,
)


def begin(path: list[Floats], tiles: tuple[Tile, ...]) -> tuple[InitialMap, int]:
    """Return the first map and the number of its second image."""
    initialization = Initialization(MATRIX, MonocularSettings())
    for number, place in enumerate(path):
        found = initialization.add(look(place, tiles))
        if found is not None:
            return found, number
    pytest.fail("no map")


WAY = [pose(0.05 * i, 0.01 * i, 0.0, yaw=0.2 * i) for i in range(20)]


@pytest.mark.parametrize("tiles", [FLAT, STEPPED, RELIEF], ids=["flat", "stepped", "relief"])
def test_motion_and_landmarks_are_those_of_the_world(tiles: tuple[Tile, ...]) -> None:
    found, number = begin(WAY, tiles)
    np.testing.assert_array_equal(found.first, look(WAY[0], tiles))
    assert np.median(found.points[:, 2]) == pytest.approx(1.0)
    true = inverse(WAY[number])
    unit = np.linalg.norm(true[:3, 3]) / np.linalg.norm(found.second[:3, 3])
    np.testing.assert_allclose(found.second[:3, :3], true[:3, :3], atol=5e-3)
    np.testing.assert_allclose(unit * found.second[:3, 3], true[:3, 3], atol=5e-3)
    depths = np.array([tile[0] for tile in tiles])
    off = np.abs(unit * found.points[:, 2, None] - depths).min(axis=1)
    assert np.median(off) < 0.02
    nearest = np.abs(unit * found.points[:, 2, None] - depths).argmin(axis=1)
    assert len(set(nearest.tolist())) >= min(3, len(tiles))  # not of one depth only


def test_landmarks_are_seen_where_the_map_says() -> None:
    found, _ = begin(WAY, RELIEF)
    for view, pixels in zip((np.eye(4), found.second), found.pixels, strict=True):
        seen = found.points @ view[:3, :3].T + view[:3, 3]
        again = (seen @ MATRIX.T)[:, :2] / seen[:, 2:]
        assert np.linalg.norm(again - pixels, axis=1).max() < 2.0


def test_it_waits_for_the_motion_that_is_asked_for() -> None:
    initializations = [
        Initialization(MATRIX, MonocularSettings(keyframe_shift=shift)) for shift in (15.0, 35.0)
    ]
    numbers = [
        next(number for number, place in enumerate(WAY) if initialization.add(look(place, FLAT)))
        for initialization in initializations
    ]
    assert numbers[0] < numbers[1]


def test_too_few_corners_begin_anew_with_the_next_image() -> None:
    dark: Grey = np.zeros((192, 256), np.uint8)
    initialization = Initialization(MATRIX, MonocularSettings())
    assert initialization.add(look(WAY[0])) is None
    assert initialization.add(dark) is None
    found = None
    for place in WAY[4:]:
        found = found or initialization.add(look(place))
    assert found is not None
    np.testing.assert_array_equal(found.first, look(WAY[4]))
