"""Bundle adjustment against a known truth, and its Jacobians against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events.geometry import inverse
from nodes.estimators.monocular_odometry.bundle import adjust, linearise
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
        for each in poses[fixed:]:
            each[:3, :3] = (
                Rotation.from_rotvec(random.normal(0, 0.01, 3)).as_matrix() @ each[:3, :3]
            )
            each[:3, 3] += random.normal(0, 0.02, 3)
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
