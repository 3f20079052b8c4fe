"""The parts of the odometry on features: corners, their surfaces, patches, and the map."""

from __future__ import annotations

import numpy as np
import pytest

from events.geometry import inverse
from nodes.estimators.images import Floats
from nodes.estimators.pose import rays
from nodes.estimators.surfaces import inverse_depth, surfaces_at
from nodes.estimators.visual_odometry.features import FeatureSettings, FeatureTracker
from nodes.estimators.visual_odometry.landmarks import (
    Landmarks,
    Patches,
    find_corners,
    find_patches,
    squares,
)
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose

MATRIX = INFO.matrix()
SIZE = INFO.width, INFO.height


def mapped(number: int = 0, seen_from: Floats | None = None) -> Landmarks:
    """Return a map of what one image shows."""
    where = pose() if seen_from is None else seen_from
    image, depth = look(where)
    corners = find_corners(image, 28, np.empty((0, 2)))
    seen = surfaces_at(inverse_depth(depth), corners, 0.002)
    landmarks = Landmarks(MATRIX)
    landmarks.add(number, inverse(where), corners[seen.continuous], seen.take(seen.continuous))
    return landmarks


def test_each_square_has_one_corner_where_none_is_taken() -> None:
    image, _ = look(pose())
    taken = np.array([[100.0, 100.0]])
    corners = find_corners(image, 28, taken)
    numbers = squares(corners, 28)
    assert len(np.unique(numbers)) == len(corners) > 60
    assert squares(taken, 28)[0] not in numbers
    assert np.abs(corners - taken).max(axis=1).min() > 10


def test_noise_of_two_grey_levels_has_no_corners() -> None:
    noise = np.random.default_rng(0).normal(128, 2, (240, 320))
    assert len(find_corners(np.rint(noise).astype(np.uint8), 28, np.empty((0, 2)))) == 0


def test_a_corner_by_an_edge_or_a_hole_has_no_surface() -> None:
    _, depth = look(pose())
    depth = depth.copy()
    depth[60, 160] = np.inf
    edge = float(np.flatnonzero(np.diff(depth[120]) != 0)[0])
    pixels = np.array(
        [[edge, 120], [edge - 5, 120], [160, 120], [30, 30], [161, 61], [170, 60]], dtype=float
    )
    seen = surfaces_at(inverse_depth(depth), pixels, 0.0015)
    assert seen.continuous.tolist() == [False, False, True, True, False, True]
    assert seen.inverse[[2, 3]] == pytest.approx([1 / 2.0, 1 / 3.0], rel=1e-4)


def test_a_hole_far_away_is_no_surface_either() -> None:
    depth = np.full((40, 60), 30.0, np.float32)
    depth[20, 30] = np.inf
    seen = surfaces_at(inverse_depth(depth), np.array([[30.0, 20.0], [31.0, 21.0]]), 0.0025)
    assert not seen.continuous.any()


def test_the_slope_of_a_slanted_wall_is_that_of_its_inverse_depth() -> None:
    columns, rows = np.meshgrid(np.arange(60), np.arange(40))
    depth = (1.0 / (0.2 + 0.002 * columns - 0.001 * rows)).astype(np.float32)
    seen = surfaces_at(inverse_depth(depth), np.array([[30.0, 20.0], [25.4, 18.7]]), 0.0015)
    assert seen.continuous.all()
    assert seen.slope == pytest.approx(np.array([[0.002, -0.001]] * 2), abs=1e-5)
    assert seen.inverse == pytest.approx([0.24, 0.2 + 0.0508 - 0.0187], abs=1e-5)


def test_warps_are_what_a_pixel_beside_a_landmark_does() -> None:
    first, then = pose(yaw=20.0), pose(x=0.5, z=0.4, yaw=5.0, pitch=6.0)
    landmarks = mapped(seen_from=first)
    rows, patches = landmarks.patches(inverse(then), np.arange(len(landmarks)))
    wall = landmarks.table["place"][rows, 2] > 2.5
    rows, patches = rows[wall], patches.take(np.flatnonzero(wall))
    for axis in (0, 1):
        beside = rays(patches.pixels + 0.01 * np.eye(2)[axis], MATRIX) @ first[:3, :3].T
        place = beside * (3.0 / beside[:, 2:])
        there = (place - then[:3, 3]) @ then[:3, :3]
        pixels = there[:, :2] / there[:, 2:] * (INFO.fx, INFO.fy) + (INFO.cx, INFO.cy)
        assert (pixels - patches.expected) / 0.01 == pytest.approx(
            patches.warps[:, :, axis], abs=0.01
        )


@pytest.mark.parametrize(
    "there",
    [pose(z=0.6), pose(z=-0.8), pose(x=0.9, yaw=-20.0), pose(y=0.4, z=0.5, pitch=12.0)],
    ids=["nearer", "farther", "aslant", "above"],
)
def test_patches_are_found_to_a_tenth_of_a_pixel_where_they_look_otherwise(there: Floats) -> None:
    landmarks, camera = mapped(), inverse(there)
    image, depth = look(there)
    rows = landmarks.in_view(camera, SIZE, -12.0, np.arange(len(landmarks)))
    rows = landmarks.unhidden(camera, inverse_depth(depth), rows, 0.002)
    rows, patches = landmarks.patches(camera, rows)
    shifted = patches.take(np.arange(len(rows)))
    shifted.expected[:] += (1.5, -1.0)  # as a pose that is a little off would have it
    pixels, matched = find_patches(shifted, {0: look(pose())[0]}, image, 11)
    assert matched.sum() > max(0.6 * len(rows), 12)
    true, _ = landmarks.project(camera, rows)
    assert np.median(np.linalg.norm(pixels - true, axis=1)[matched]) < 0.1


def test_what_stands_behind_the_box_is_hidden() -> None:
    landmarks = mapped(seen_from=pose(x=2.2))
    behind = np.abs(landmarks.table["place"][:, :2]).max(axis=1) < 0.7
    behind &= landmarks.table["place"][:, 2] > 2.5
    _, depth = look(pose())
    rows = landmarks.in_view(np.eye(4), SIZE, -12.0, np.arange(len(landmarks)))
    seen = landmarks.unhidden(np.eye(4), inverse_depth(depth), rows, 0.002)
    assert behind[rows].sum() > 3
    assert not behind[seen].any()
    holes = inverse_depth(np.full_like(depth, np.inf))
    assert len(landmarks.unhidden(np.eye(4), holes, rows, 0.002)) == len(rows)


def test_readings_of_depth_from_elsewhere_average_out() -> None:
    random = np.random.default_rng(1)
    image, depth = look(pose())
    noisy = (1 / (1 / depth + random.normal(0, 0.01, depth.shape))).astype(np.float32)
    corners = find_corners(image, 28, np.empty((0, 2)))
    corners = corners[surfaces_at(inverse_depth(depth), corners, 0.01).continuous]
    seen = surfaces_at(inverse_depth(noisy), corners, 0.02)
    corners, seen = corners[seen.continuous], seen.take(seen.continuous)
    landmarks = Landmarks(MATRIX)
    rows = landmarks.add(0, np.eye(4), corners, seen)
    wall = np.where(landmarks.table["place"][:, 2] > 2.5, 3.0, 2.0)
    first = np.abs(landmarks.table["place"][:, 2] - wall).mean()
    for step in range(16):
        there = pose(x=0.02 * step, z=0.02 * step)
        _, depth = look(there)
        noisy = (1 / (1 / depth + random.normal(0, 0.01, depth.shape))).astype(np.float32)
        pixels, _ = landmarks.project(inverse(there), rows)
        read = surfaces_at(inverse_depth(noisy), pixels, 0.02)
        landmarks.fuse(inverse(there), rows, read, 0.02)
    assert np.abs(landmarks.table["place"][:, 2] - wall).mean() < 0.5 * first


def test_a_landmark_that_is_missed_rests_and_comes_back() -> None:
    landmarks, row = mapped(), np.array([3])
    none = np.empty(0, np.int64)
    landmarks.update_found(10, none, row)
    assert len(landmarks.active(11, row)) == 0
    assert len(landmarks.active(12, row)) == 1
    landmarks.update_found(12, none, row)
    assert len(landmarks.active(16, row)) == 0
    landmarks.update_found(20, row, none)
    landmarks.update_found(21, none, row)
    assert len(landmarks.active(23, row)) == 1


def test_forgetting_a_key_frame_leaves_the_others_as_they_were() -> None:
    landmarks = mapped(0)
    count = len(landmarks)
    _, depth = look(pose())
    more = np.array([[40.0, 40.0], [280.0, 200.0]])
    landmarks.add(1, np.eye(4), more, surfaces_at(inverse_depth(depth), more, 0.002))
    assert landmarks.forget_before(1) == count
    assert landmarks.table["pixel"].tolist() == more.tolist()
    _, patches = landmarks.patches(np.eye(4), np.arange(2))
    assert patches.expected == pytest.approx(more)
    assert patches.warps == pytest.approx(np.stack([np.eye(2)] * 2), abs=1e-6)


@pytest.mark.slow
def test_few_key_frames_remembered_do_for_a_path() -> None:
    tracker = FeatureTracker(INFO, FeatureSettings(keyframes=2, keyframe_shift=8.0))
    for index in range(30):
        there = pose(x=0.02 * index, yaw=0.2 * index)
        said = tracker.track(index * 33_000_000, *look(there))
    assert not said.lost
    assert np.linalg.norm(said.pose[:3, 3] - there[:3, 3]) < 0.01


def test_images_without_depth_are_followed_on_the_map_there_is() -> None:
    tracker = FeatureTracker(INFO)
    for index in range(12):
        image, depth = look(there := pose(x=0.02 * index))
        said = tracker.track(index * 33_000_000, image, depth if index < 3 else depth * np.inf)
    assert not said.lost
    assert np.linalg.norm(said.pose[:3, 3] - there[:3, 3]) < 0.01


@pytest.mark.slow
def test_a_lost_camera_finds_a_key_frame_that_optical_flow_does_not_reach() -> None:
    tracker = FeatureTracker(INFO, FeatureSettings(keyframe_shift=30.0))
    for index in range(28):
        tracker.track(index * 33_000_000, *look(pose(x=0.12 * index)))
    dark = np.zeros((240, 320), np.uint8), np.full((240, 320), np.inf, np.float32)
    assert tracker.track(28 * 33_000_000, *dark).lost
    there = pose(x=0.1, yaw=-2.0)
    image = look(there)
    for index in range(29, 45):
        said = tracker.track(index * 33_000_000, *image)
        if not said.lost:
            break
    assert not said.lost
    assert said.reason == "against a key frame"
    assert np.linalg.norm(said.pose[:3, 3] - there[:3, 3]) < 0.01


def test_a_patch_of_noise_is_not_found_where_it_is_expected() -> None:
    first, second = np.random.default_rng(1).integers(60, 120, (2, 200, 300), np.uint8)
    pixels = np.array([(x, y) for x in range(40, 260, 20) for y in range(40, 160, 20)], np.float64)
    turns = np.tile(np.eye(2), (len(pixels), 1, 1))
    patches = Patches(np.zeros(len(pixels), np.int64), pixels, pixels, turns)
    assert find_patches(patches, {0: first}, first, 11)[1].all()
    assert find_patches(patches, {0: first}, second, 11)[1].mean() < 0.05
