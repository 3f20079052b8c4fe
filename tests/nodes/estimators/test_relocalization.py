"""A lost camera is relocalized by a key frame, and not by one of another place."""

from __future__ import annotations

import numpy as np
import pytest

from nodes.estimators.images import Floats
from nodes.estimators.monocular_odometry.geometry import new_corners
from nodes.estimators.pose import rays, solve_pose
from nodes.estimators.relocalization import (
    DescribedPoints,
    describe,
    detect_and_describe,
    relocalize,
)
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose


def keyframe() -> DescribedPoints:
    """Return the corners of the image at the origin, placed where its depth has them."""
    image, depth = look(pose())
    pixels = new_corners(image, np.empty((0, 2)), 300)
    column, row = np.rint(pixels).astype(int).T
    return describe(image, pixels, rays(pixels, INFO.matrix()) * depth[row, column][:, None])


def find(there: Floats) -> Floats | None:
    return relocalize(*detect_and_describe(look(there)[0], 1000), keyframe(), INFO.matrix())


@pytest.mark.parametrize("there", [pose(), pose(x=-0.15, yaw=3.0), pose(z=0.4)])
def test_a_key_frame_is_recognized_from_elsewhere(there: Floats) -> None:
    pose = find(there)
    assert pose is not None
    np.testing.assert_allclose(np.linalg.inv(pose)[:3, 3], there[:3, 3], atol=0.12)


def test_what_is_not_in_the_image_is_not_recognized() -> None:
    assert find(pose(x=-6.0, y=6.0)) is None


def test_a_blank_image_has_no_points() -> None:
    pixels, descriptors = detect_and_describe(np.zeros((240, 320), np.uint8), 1000)
    assert (pixels.shape, descriptors.shape) == ((0, 2), (0, 32))
    assert relocalize(pixels, descriptors, keyframe(), INFO.matrix()) is None


def test_corners_at_the_edge_are_not_described() -> None:
    image, _ = look(pose())
    edge = np.array([[2.0, 2.0], [160.0, 120.0]])
    described = describe(image, edge, np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    assert described.points.tolist() == [[2.0, 0.0, 0.0]]
    assert describe(image, edge[:1], np.ones((1, 3))).points.shape == (0, 3)


def test_landmarks_in_one_column_of_pixels_leave_open_what_they_do_not_tell() -> None:
    for seed in range(300):
        random = np.random.default_rng(seed)
        count, depth = int(random.integers(15, 40)), float(random.uniform(3, 30))
        pixels = np.stack([np.full(count, random.integers(400)), 10.0 + 7 * np.arange(count)], 1)
        if seed % 2:
            pixels[:] = pixels[0]
        matrix = INFO.matrix()
        landmarks = depth * rays(pixels, matrix)
        view, _ = solve_pose(landmarks, pixels, np.eye(4), matrix, 0.3)
        assert np.allclose(view, np.eye(4), atol=1e-6)
