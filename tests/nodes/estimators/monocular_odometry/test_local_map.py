"""The map: how it begins, and what a new key frame adds to it, corrects and forgets."""

from __future__ import annotations

import numpy as np
import pytest

from events.geometry import inverse
from nodes.estimators.monocular_odometry.geometry import SPACING, MonocularSettings, new_corners
from nodes.estimators.monocular_odometry.local_map import (
    Initialization,
    InitialMap,
    LocalMap,
    Tracks,
)
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

BLANK: Grey = np.zeros((192, 256), np.uint8)
"""There are no corners in it: tracks are those that the tests give."""
SETTINGS = MonocularSettings()
POINTS = np.random.default_rng(1).uniform((-0.4, -0.5, 1.6), (1.4, 0.5, 2.6), (80, 3))


def project(place: Floats, points: Floats = POINTS) -> Floats:
    view = inverse(place)
    seen = points @ view[:3, :3].T + view[:3, 3]
    return np.asarray((seen @ MATRIX.T)[:, :2] / seen[:, 2:])


PLACES = [pose(0.2 * i, 0.02 * i, 0.01 * i, yaw=i) for i in range(14)]


def begin() -> LocalMap:
    """Return a map of the first two places, in which half of the corners have no place yet."""
    pixels = np.stack([project(PLACES[0]), project(PLACES[1])])
    initial = InitialMap(BLANK, inverse(PLACES[1]), pixels, POINTS)
    made = LocalMap.first(initial, BLANK, np.eye(4), 1.0, MATRIX, SETTINGS)
    made.tracks.points[40:] = np.nan
    return made


def test_the_first_map_is_put_where_it_begins_and_in_the_worlds_unit() -> None:
    start = pose(3.0, 1.0, -2.0, yaw=30, pitch=10)
    pixels = np.stack([project(PLACES[0]), project(PLACES[1])])
    initial = InitialMap(BLANK, inverse(PLACES[1]), pixels, POINTS)
    made = LocalMap.first(initial, BLANK, start, 2.0, MATRIX, SETTINGS)
    second = PLACES[1].copy()
    second[:3, 3] *= 2.0
    np.testing.assert_allclose(made.pose, inverse(start @ second), atol=1e-12)
    expected = 2.0 * POINTS @ start[:3, :3].T + start[:3, 3]
    np.testing.assert_allclose(made.tracks.points, expected)
    seen = 2.0 * (POINTS @ inverse(PLACES[1])[:3, :3].T + inverse(PLACES[1])[:3, 3])
    assert made.depth == pytest.approx(np.median(seen[:, 2]))
    np.testing.assert_array_equal(initial.second, inverse(PLACES[1]))  # left alone


def test_corners_of_no_known_place_are_supposed_at_the_median_depth() -> None:
    made = begin()
    supposed = made.approximate_points()
    np.testing.assert_array_equal(supposed[:40], POINTS[:40])
    seen = supposed[40:] @ made.pose[:3, :3].T + made.pose[:3, 3]
    np.testing.assert_allclose(seen[:, 2], made.depth)
    np.testing.assert_allclose(project(inverse(made.pose), supposed), made.tracks.pixels, atol=1e-9)


def test_a_key_frame_places_corners_and_corrects_poses_and_landmarks() -> None:
    made = begin()
    made.tracks.points[:40] += np.random.default_rng(2).normal(0, 0.005, (40, 3))
    for number in (2, 3, 4):
        off = PLACES[number].copy()
        off[:3, 3] += (0.004, -0.004, 0.004)
        made.add_keyframe(BLANK, inverse(off), np.arange(80), project(PLACES[number]))
    np.testing.assert_allclose(inverse(made.pose), PLACES[4], atol=2e-3)
    assert made.tracks.known.all()
    np.testing.assert_allclose(made.tracks.points, POINTS, atol=0.02)


def test_a_corner_that_fits_nowhere_is_dropped() -> None:
    made = begin()
    pixels = project(PLACES[2])
    pixels[3] += 9.0
    made.add_keyframe(BLANK, inverse(PLACES[2]), np.arange(80), pixels)
    assert len(made.tracks) == 79
    assert np.abs(made.tracks.pixels - pixels[3]).max(axis=1).min() > 0.5


def test_landmarks_out_of_sight_still_hold_the_key_frames_that_saw_them() -> None:
    made = begin()
    made.tracks.points[:] = POINTS
    here, there = project(PLACES[2]), project(PLACES[3])
    here[:8] += (1.2, -0.8)  # the last to stay in sight are followed a little wrongly
    there[:8] += (1.2, -0.8)
    made.add_keyframe(BLANK, inverse(PLACES[2]), np.arange(80), here)
    before = made.pose
    made.add_keyframe(BLANK, inverse(PLACES[3]), np.arange(8), there[:8])
    after = made._poses[2]
    assert 0 < np.abs(after - before).max() < 3e-4


def test_key_frames_that_nothing_needs_are_forgotten() -> None:
    made = begin()
    for number, place in enumerate(PLACES[2:], 2):
        rows = np.arange(len(made.tracks))
        if number == 4:
            rows = rows[40:]
            made.tracks.views = [{3: next(iter(views.values()))} for views in made.tracks.views]
            made.tracks.add_view(3, project(PLACES[3], POINTS))
        points = POINTS[40:] if number >= 4 else POINTS
        made.add_keyframe(BLANK, inverse(place), rows, project(place, points))
    assert made.newest == 13
    assert made.keyframes == [3, *range(6, 14)]  # the last eight, and where the corners were first


def test_a_remembered_key_frame_is_a_map() -> None:
    made = begin()
    again = LocalMap.around(made.keyframe(), MATRIX, SETTINGS)
    np.testing.assert_array_equal(again.pose, made.pose)
    np.testing.assert_array_equal(again.tracks.points, POINTS[:40])
    np.testing.assert_array_equal(again.tracks.pixels, made.tracks.pixels[:40])
    again.tracks.points += 1.0
    np.testing.assert_array_equal(made.keyframe().landmarks, POINTS[:40])


def initialized(path: list[Floats], tiles: tuple[Tile, ...]) -> tuple[InitialMap, int]:
    """Return the first map and the number of its second image."""
    initialization = Initialization(MATRIX, MonocularSettings())
    for number, place in enumerate(path):
        initial = initialization.add(look(place, tiles))
        if initial is not None:
            return initial, number
    pytest.fail("no map")


WAY = [pose(0.05 * i, 0.01 * i, 0.0, yaw=0.2 * i) for i in range(20)]


@pytest.mark.parametrize("tiles", [FLAT, STEPPED, RELIEF], ids=["flat", "stepped", "relief"])
def test_motion_and_landmarks_are_those_of_the_world(tiles: tuple[Tile, ...]) -> None:
    initial, number = initialized(WAY, tiles)
    np.testing.assert_array_equal(initial.first, look(WAY[0], tiles))
    assert np.median(initial.points[:, 2]) == pytest.approx(1.0)
    true = inverse(WAY[number])
    unit = np.linalg.norm(true[:3, 3]) / np.linalg.norm(initial.second[:3, 3])
    np.testing.assert_allclose(initial.second[:3, :3], true[:3, :3], atol=5e-3)
    np.testing.assert_allclose(unit * initial.second[:3, 3], true[:3, 3], atol=5e-3)
    depths = np.array([tile[0] for tile in tiles])
    off = np.abs(unit * initial.points[:, 2, None] - depths).min(axis=1)
    assert np.median(off) < 0.02
    nearest = np.abs(unit * initial.points[:, 2, None] - depths).argmin(axis=1)
    assert len(set(nearest.tolist())) >= min(3, len(tiles))  # not of one depth only


def test_landmarks_are_seen_where_the_map_says() -> None:
    initial, _ = initialized(WAY, RELIEF)
    for view, pixels in zip((np.eye(4), initial.second), initial.pixels, strict=True):
        seen = initial.points @ view[:3, :3].T + view[:3, 3]
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
    initial = None
    for place in WAY[4:]:
        initial = initial or initialization.add(look(place))
    assert initial is not None
    np.testing.assert_array_equal(initial.first, look(WAY[4]))


HERE = look(pose(), FLAT)


def test_tracks_remember_their_views_and_hand_over_landmarks_that_leave() -> None:
    tracks = Tracks(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), 0)
    assert not tracks.known.any()
    tracks.points[:2] = [[0, 0, 1], [0, 0, 2]]
    gone = tracks.retain(np.array([1, 2]))
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
