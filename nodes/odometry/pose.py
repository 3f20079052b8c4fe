"""The pose of a camera from the pixels and depths of landmarks: robust Gauss-Newton.

Residuals of each landmark are its two pixels and its inverse depth, each in units of its noise, as
a stereo camera's three coordinates would be (R. Mur-Artal and J. D. Tardós, "ORB-SLAM2", IEEE
T-RO 2017, section III-A); weights are Huber's.
"""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.odometry.images import Floats

_HUBER = 2.0
"""Standard deviations beyond which a residual counts linearly."""
_STEPS = 8
_SMALL = 1e-7


class Observations(msgspec.Struct, frozen=True, eq=False):
    """Landmarks as one image shows them.

    Attributes:
        landmarks: Metres in the world, shape (n, 3).
        pixels: Column and row, shape (n, 2).
        inverse: Measured inverse depth, 1/m, shape (n,).
        measured: Which have a measured inverse depth, shape (n,).
    """

    landmarks: Floats
    pixels: Floats
    inverse: Floats
    measured: npt.NDArray[np.bool_]

    @classmethod
    def without_depth(cls, landmarks: Floats, pixels: Floats) -> Observations:
        """Return observations of pixels only."""
        count = len(landmarks)
        return cls(landmarks, pixels, np.zeros(count), np.zeros(count, np.bool_))


class Solution(msgspec.Struct, frozen=True, eq=False):
    """A pose, and the errors of the landmarks under it.

    Attributes:
        pose: World to camera, shape (4, 4).
        errors: Reprojection errors in standard deviations, shape (n,).
    """

    pose: Floats
    errors: Floats


def solve_pose(
    seen: Observations,
    start: Floats,
    matrix: Floats,
    pixel_noise: float,
    depth_noise: float,
) -> Solution:
    """Return the pose that minimises the sum of robust squared residuals.

    Args:
        seen: At least four landmarks.
        start: Initial pose, world to camera, shape (4, 4).
        matrix: K, shape (3, 3).
        pixel_noise: Standard deviation of a coordinate, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m.
    """
    fx, fy, cx, cy = intrinsics(matrix)
    pose = start.copy()
    target = (seen.pixels - (cx, cy)) / (fx, fy)
    a, b = fx / pixel_noise, fy / pixel_noise
    c = np.where(seen.measured, 1.0 / depth_noise, 0.0)
    jacobian = np.zeros((len(target), 3, 6))
    for _ in range(_STEPS):
        p = seen.landmarks @ pose[:3, :3].T + pose[:3, 3]
        ahead = p[:, 2] > 0.01
        inverse = 1.0 / np.where(ahead, p[:, 2], 1.0)
        x, y = p[:, 0] * inverse, p[:, 1] * inverse
        residuals = np.stack(
            [a * (x - target[:, 0]), b * (y - target[:, 1]), c * (inverse - seen.inverse)], axis=1
        )
        # By a small motion of the camera's frame: translation, then rotation (left perturbation).
        jacobian[:, 0] = a * np.stack([inverse, 0 * x, -x * inverse, -x * y, 1 + x * x, -y], axis=1)
        jacobian[:, 1] = b * np.stack([0 * x, inverse, -y * inverse, -1 - y * y, x * y, x], axis=1)
        slope = -c * inverse * inverse
        jacobian[:, 2, 2:5] = np.stack([slope, slope * p[:, 1], -slope * p[:, 0]], axis=1)
        errors = np.hypot(residuals[:, 0], residuals[:, 1])
        depth_errors = np.abs(residuals[:, 2])
        weights = np.stack([_huber(errors), _huber(errors), _huber(depth_errors)], axis=1)
        weights *= ahead[:, None]
        weighted = (jacobian * weights[..., None]).reshape(-1, 6)
        flat = jacobian.reshape(-1, 6)
        normal = weighted.T @ flat + 1e-9 * np.eye(6)
        step = -np.linalg.solve(normal, weighted.T @ residuals.reshape(-1))
        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = turn @ pose[:3, 3] + step[:3]
        if np.abs(step).max() < _SMALL:
            break
    errors[~ahead] = np.inf
    return Solution(pose, errors)


def _huber(errors: Floats) -> Floats:
    return np.asarray(np.minimum(1.0, _HUBER / np.maximum(errors, _HUBER)))


def intrinsics(matrix: Floats) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of K, shape (3, 3)."""
    return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]


def rays(pixels: Floats, matrix: Floats) -> Floats:
    """Return directions in the optical frame with z = 1, shape (n, 3), of pixels, shape (n, 2)."""
    fx, fy, cx, cy = intrinsics(matrix)
    return np.stack(
        [(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1
    )


def from_rotation_vector(rotation: npt.NDArray[Any], translation: npt.NDArray[Any]) -> Floats:
    """Return the transform, shape (4, 4), of a rotation vector and a translation, as OpenCV's."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return pose
