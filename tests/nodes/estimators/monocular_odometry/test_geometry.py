"""Geometry of two views and bundle adjustment: against values by hand, a truth, differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events.geometry import inverse
from nodes.estimators.monocular_odometry.geometry import (
    adjust,
    centre,
    hypotheses,
    linearise,
    parallax,
    reprojection_errors,
    triangulate,
)
from nodes.estimators.pose import rays
from tests.nodes.estimators.monocular_odometry.world import MATRIX, Floats, pose

NOISE = 0.5
SCALE = np.array([MATRIX[0, 0], MATRIX[1, 1]]) / NOISE


class Scene:
    """Five cameras in a row; most see most of sixty points."""

    def __init__(self) -> None:
        random = np.random.default_rng(3)
        places = [pose(0.25 * i, 0.03 * i, -0.05 * i, yaw=-2 * i, pitch=i) for i in range(5)]
        self.poses = np.stack([inverse(place) for place in places])
        self.points = random.uniform((-1, -0.8, 2.0), (2, 0.8, 3.5), (60, 3))
        seen = random.random((60, 5)) < 0.8
        seen[:, 1:3] = True
        self.landmark, self.frame = np.nonzero(seen)
        self.pixels = self.project(self.poses, self.points)

    def project(self, poses: Floats, points: Floats) -> Floats:
        turns, shifts = poses[self.frame, :3, :3], poses[self.frame, :3, 3]
        seen = np.einsum("mij,mj->mi", turns, points[self.landmark]) + shifts
        return np.asarray((seen @ MATRIX.T)[:, :2] / seen[:, 2:])

    def perturbed(self, fixed: int) -> tuple[Floats, Floats]:
        random = np.random.default_rng(4)
        poses = self.poses.copy()
        for view in poses[fixed:]:
            view[:3, :3] = (
                Rotation.from_rotvec(random.normal(0, 0.01, 3)).as_matrix() @ view[:3, :3]
            )
            view[:3, 3] += random.normal(0, 0.02, 3)
        return poses, self.points + random.normal(0, 0.03, self.points.shape)

    def adjust(self, fixed: int, pixels: Floats, steps: int) -> tuple[Floats, Floats, Floats]:
        return adjust(
            *self.perturbed(fixed),
            self.frame,
            self.landmark,
            pixels,
            MATRIX,
            fixed=fixed,
            noise=NOISE,
            steps=steps,
        )


@pytest.mark.parametrize("fixed", [2, 5])
def test_perturbed_poses_and_landmarks_return_to_the_truth(fixed: int) -> None:
    scene = Scene()
    poses, points, errors = scene.adjust(fixed, scene.pixels, 8)
    np.testing.assert_allclose(poses, scene.poses, atol=1e-4)
    np.testing.assert_allclose(points, scene.points, atol=1e-3)
    assert errors.max() < 0.02
    np.testing.assert_array_equal(poses[:fixed], scene.poses[:fixed])


def test_with_one_fixed_camera_all_is_right_but_the_unit_of_length() -> None:
    scene = Scene()
    poses, points, errors = scene.adjust(1, scene.pixels, 12)
    assert errors.max() < 0.02
    ratio = points / scene.points
    assert ratio.std() < 1e-2
    np.testing.assert_allclose(poses[:, :3, :3], scene.poses[:, :3, :3], atol=1e-3)


def test_a_corner_followed_wrongly_moves_little_and_its_error_tells() -> None:
    scene = Scene()
    pixels = scene.pixels.copy()
    wrong = np.flatnonzero(scene.frame == 3)[::7]
    pixels[wrong] += 25.0
    poses, _, errors = scene.adjust(2, pixels, 10)
    assert np.abs(poses - scene.poses).max() < 0.02
    assert errors[wrong].min() > 5.0
    assert np.median(np.delete(errors, wrong)) < 0.5


def test_what_was_given_is_left_alone_and_errors_are_pixels() -> None:
    scene = Scene()
    poses, points = scene.perturbed(2)
    before = poses.copy(), points.copy()
    given = poses, points, scene.frame, scene.landmark, scene.pixels, MATRIX
    adjust(*given, fixed=2, noise=NOISE, steps=2)
    *_, errors = adjust(*given, fixed=2, noise=NOISE, steps=0)
    np.testing.assert_array_equal(poses, before[0])
    np.testing.assert_array_equal(points, before[1])
    missed = np.linalg.norm(scene.project(poses, points) - scene.pixels, axis=1)
    np.testing.assert_allclose(errors, missed)


def test_jacobians_are_those_of_the_residuals() -> None:
    scene = Scene()
    poses, points = scene.perturbed(0)
    target = (scene.pixels - MATRIX[:2, 2]) / (MATRIX[0, 0], MATRIX[1, 1])

    def residuals(poses: Floats, points: Floats) -> Floats:
        return linearise(poses, points, scene.frame, scene.landmark, target, SCALE)[0]

    _, by_pose, by_point, weights = linearise(
        poses, points, scene.frame, scene.landmark, target, SCALE
    )
    step = 1e-6
    for axis in range(6):
        moved = []
        for sign in (1.0, -1.0):
            motion = np.zeros(6)
            motion[axis] = sign * step
            small = np.eye(4)
            small[:3, :3] = Rotation.from_rotvec(motion[3:]).as_matrix()
            small[:3, 3] = motion[:3]
            moved.append(residuals(small @ poses, points))
        np.testing.assert_allclose(
            by_pose[:, :, axis], (moved[0] - moved[1]) / (2 * step), rtol=1e-5, atol=1e-4
        )
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (residuals(poses, points + shift) - residuals(poses, points - shift)) / (2 * step)
        np.testing.assert_allclose(by_point[:, :, axis], slope, rtol=1e-5, atol=1e-4)
    assert (weights <= 1.0).all()


def test_a_landmark_behind_a_camera_has_no_weight() -> None:
    ahead_and_behind = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    indices = np.zeros(2, np.int64), np.arange(2)
    *_, weights = linearise(np.eye(4)[None], ahead_and_behind, *indices, np.zeros((2, 2)), SCALE)
    assert weights.tolist() == [1.0, 0.0]


K = np.array([[100.0, 0.0, 50.0], [0.0, 200.0, 40.0], [0.0, 0.0, 1.0]])
RIGHT = inverse(pose(x=1.0))
"""A camera a metre to the right of the first, world to camera."""
metres = st.floats(-1, 1)
degrees = st.floats(-20, 20)


def project(view: Floats, points: Floats) -> Floats:
    seen = points @ view[:3, :3].T + view[:3, 3]
    return np.asarray((seen @ MATRIX.T)[:, :2] / seen[:, 2:])


def test_rays_by_hand() -> None:
    directions = rays(np.array([[50.0, 40.0], [150.0, 0.0]]), K)
    np.testing.assert_allclose(directions, [[0.0, 0.0, 1.0], [1.0, -0.2, 1.0]])


def test_a_centre_is_where_the_camera_is() -> None:
    np.testing.assert_allclose(centre(inverse(pose(1, 2, 3, yaw=40, pitch=-20))), (1, 2, 3))


def test_triangulation_by_hand() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]]), np.array([[-0.5, 0.0, 1.0]])
    np.testing.assert_allclose(
        triangulate(np.eye(4), RIGHT, straight, slant), [[0, 0, 2]], atol=1e-12
    )


def test_rays_that_pass_each_other_meet_in_the_middle() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]]), np.array([[-0.5, 0.0, 1.0]])
    below = inverse(pose(x=1.0, y=0.2))
    np.testing.assert_allclose(
        triangulate(np.eye(4), below, straight, slant), [[0, 0.1, 2]], atol=1e-12
    )


def test_parallel_rays_meet_nowhere() -> None:
    straight = np.array([[0.0, 0.0, 1.0]])
    assert not np.isfinite(triangulate(np.eye(4), RIGHT, straight, straight)).any()


def test_parallax_by_hand() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]] * 2), np.array([[-1.0, 0.0, 1.0], [0, 0, 3.0]])
    np.testing.assert_allclose(parallax(np.eye(4), RIGHT, straight, slant), [45, 0])
    turned = inverse(pose(yaw=30))  # turning alone shows nothing from another side
    same = straight[:1] @ turned[:3, :3].T
    np.testing.assert_allclose(parallax(np.eye(4), turned, straight[:1], same), [0], atol=1e-9)


def test_reprojection_errors_by_hand() -> None:
    points = np.array([[0.0, 0.0, 2.0], [1.0, 1.0, 2.0], [0.0, 0.0, -2.0], [np.nan, 0.0, 2.0]])
    pixels = np.array([[50.0, 40.0], [103.0, 136.0], [50.0, 40.0], [50.0, 40.0]])
    errors = reprojection_errors(np.eye(4), points, pixels, K)
    np.testing.assert_allclose(errors, [0, 5, np.inf, np.inf])


@pytest.mark.slow
@given(st.tuples(metres, metres, metres, degrees, degrees), st.lists(metres, min_size=3))
def test_what_two_cameras_see_is_triangulated_where_it_is(
    motion: tuple[float, ...], numbers: list[float]
) -> None:
    points = np.resize(numbers, (len(numbers) // 3, 3)) + np.array([0.0, 0.0, 6.0])
    first, second = inverse(pose(-1.5, pitch=5)), inverse(pose(*motion))
    pixels = project(first, points), project(second, points)
    a, b = (rays(observed, MATRIX) for observed in pixels)
    np.testing.assert_allclose(triangulate(first, second, a, b), points, atol=1e-6)
    for view, observed in zip((first, second), pixels, strict=True):
        assert reprojection_errors(view, points, observed, MATRIX).max() < 1e-8
    to = points - centre(first), points - centre(second)
    cosine = np.sum(to[0] * to[1], axis=1) / np.prod(np.linalg.norm(to, axis=2), axis=0)
    expected = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    np.testing.assert_allclose(parallax(first, second, a, b), expected, atol=1e-4)


@pytest.mark.parametrize("relief", [0.0, 1.0], ids=["plane", "relief"])
def test_the_true_motion_is_among_the_hypotheses(relief: float) -> None:
    random = np.random.default_rng(2)
    points = random.uniform((-1.2, -0.9, 2.0), (1.2, 0.9, 2.0 + relief), (80, 3))
    second = inverse(pose(0.3, -0.1, 0.1, yaw=3, pitch=-2))
    first, last = project(np.eye(4), points), project(second, points)
    last[:4] += 30.0  # followed wrongly
    length = np.linalg.norm(second[:3, 3])
    misses = []
    for motion in hypotheses(first, last, MATRIX):
        assert np.linalg.norm(motion[:3, 3]) == pytest.approx(1.0)
        assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)
        again = motion.copy()
        again[:3, 3] *= length
        misses.append(np.abs(again - second).max())
    assert min(misses) < 2e-3
