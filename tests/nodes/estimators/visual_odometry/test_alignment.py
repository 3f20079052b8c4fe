"""The odometry on features where there are hardly any: plain surfaces, outlines, and losses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from events.geometry import inverse
from nodes.estimators import TrackingResult
from nodes.estimators.images import Floats
from nodes.estimators.pose import moved
from nodes.estimators.visual_odometry.alignment import Motion
from nodes.estimators.visual_odometry.features import FeatureTracker
from tests.nodes.estimators.visual_odometry.world import INFO, pose

FRAME = 33_000_000
Plane = tuple[int, float, float, tuple[float, float, float, float]]
"""Axis, place on it, grey level, and limits on the two other axes."""
_FAR = 50.0
WALL: Plane = (2, 3.0, 140.0, (-_FAR, _FAR, -_FAR, _FAR))
FLOOR: Plane = (1, 1.0, 90.0, (-_FAR, _FAR, -_FAR, _FAR))
LEFT: Plane = (0, -2.0, 115.0, (-_FAR, _FAR, -_FAR, _FAR))
BOX: Plane = (2, 2.0, 60.0, (-0.4, 0.5, -0.3, 0.6))
POST: Plane = (2, 2.5, 190.0, (0.8, 0.95, -2.0, 1.0))
ROOM = (WALL, FLOOR, LEFT, BOX, POST)
PATH = [pose(x=0.02 * i, z=0.01 * i, yaw=0.2 * i) for i in range(40)]


def draw(
    planes: tuple[Plane, ...], camera: Floats, gain: float = 1.0, seed: int = 0
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Return what a camera sees of surfaces of one grey level each, with noise, and its depth."""
    columns, rows = np.meshgrid(np.arange(INFO.width), np.arange(INFO.height))
    rays = np.stack(
        [(columns - INFO.cx) / INFO.fx, (rows - INFO.cy) / INFO.fy, np.ones(columns.shape)], axis=-1
    )
    world = rays @ camera[:3, :3].T
    image, depth = np.full(columns.shape, 20.0), np.full(columns.shape, np.inf)
    for axis, place, level, (low, high, lower, higher) in planes:
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (place - camera[axis, 3]) / world[..., axis]
        first, second = (other for other in range(3) if other != axis)
        with np.errstate(invalid="ignore"):
            u = camera[first, 3] + reach * world[..., first]
            v = camera[second, 3] + reach * world[..., second]
            hit = (reach > 0) & (reach < depth) & (u > low) & (u < high)
            hit &= (v > lower) & (v < higher)
        image[hit], depth[hit] = level, reach[hit]
    random = np.random.default_rng(seed)
    noisy = image * gain + random.normal(0.0, 2.0, image.shape)
    with np.errstate(invalid="ignore"):
        depth += random.normal(0.0, 0.0015, depth.shape) * np.where(depth < _FAR, depth, 0.0) ** 2
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), depth.astype(np.float32)


def follow(
    planes: tuple[Plane, ...], path: list[Floats], gains: Floats | None = None
) -> list[TrackingResult]:
    tracker = FeatureTracker(INFO)
    gains = np.ones(len(path)) if gains is None else gains
    return [
        tracker.track(i * FRAME, *draw(planes, place, float(gains[i]), seed=i))
        for i, place in enumerate(path)
    ]


def off(result: TrackingResult, true: Floats) -> float:
    return float(np.linalg.norm(result.pose[:3, 3] - true[:3, 3]))


@pytest.mark.slow
def test_a_room_without_corners_of_its_own_is_enough() -> None:
    said = follow(ROOM, PATH)
    assert not any(result.lost for result in said)
    assert max(off(result, true) for result, true in zip(said, PATH, strict=True)) < 0.02


def test_outlines_in_front_of_a_flat_wall_belong_to_what_is_nearer() -> None:
    path = [pose(x=0.02 * i) for i in range(12)]
    said = follow((WALL, BOX, POST), path)
    assert not any(result.lost for result in said)
    assert off(said[-1], path[-1]) < 0.02


def test_a_change_of_exposure_is_no_motion() -> None:
    gains = 1.0 + 0.3 * np.sin(np.arange(15) / 3.0)
    said = follow(ROOM, [pose()] * 15, gains)
    assert not any(result.lost for result in said)
    assert max(off(result, pose()) for result in said) < 0.01


def test_a_flat_wall_alone_says_too_little() -> None:
    assert all(result.lost for result in follow((WALL,), [pose(x=0.02 * i) for i in range(3)]))


@pytest.mark.slow
def test_the_motion_during_a_loss_is_found_again() -> None:
    tracker = FeatureTracker(INFO)
    dark = np.zeros((240, 320), np.uint8), np.full((240, 320), np.inf, np.float32)
    said = [
        tracker.track(i * FRAME, *(dark if 10 <= i < 25 else draw(ROOM, view, seed=i)))
        for i, view in enumerate(PATH)
    ]
    assert [result.lost for result in said] == [10 <= i < 25 for i in range(len(PATH))]
    assert max(off(said[i], PATH[i]) for i in (25, 39)) < 0.03


def test_an_expected_motion_fades_while_nothing_is_measured() -> None:
    motion, step = Motion(), np.array([0.03, 0, 0, 0, 0.01, 0])
    motion.measured(0, np.eye(4))
    motion.measured(FRAME, moved(np.eye(4), step))
    expected = moved(moved(np.eye(4), step), step)
    assert motion.expected(2 * FRAME) == pytest.approx(expected)
    places = [motion.carried(i * FRAME)[0, 3] for i in range(2, 200)]
    steps = np.diff([inverse(np.eye(4))[0, 3], *places])
    assert places[-1] < 0.6  # of 6 m at the first velocity
    assert abs(steps[-1]) < 1e-4
