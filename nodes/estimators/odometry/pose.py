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

from events.geometry import inverse
from nodes.estimators.odometry.images import Floats

_HUBER = 2.0
"""Standard deviations beyond which a residual counts linearly."""
_STEPS = 8
_SMALL = 1e-7
_DAMPING = 1e-9
"""Share of its own information by which each motion is held back."""


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
    information: Floats | None = None,
) -> Solution:
    """Return the pose that minimises the sum of robust squared residuals.

    Args:
        seen: At least four landmarks, or fewer if something is known of the initial pose.
        start: Initial pose, world to camera, shape (4, 4).
        matrix: K, shape (3, 3).
        pixel_noise: Standard deviation of a coordinate, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m.
        information: Inverse covariance of the initial pose, if that is more than a guess: of a
            small motion of the camera's frame, translation, then rotation, shape (6, 6).
    """
    fx, fy, cx, cy = intrinsics(matrix)
    pose, count = start.copy(), len(seen.pixels)
    # In rows of contiguous memory: coordinates, and derivatives of each by the six motions.
    landmarks = np.ascontiguousarray(seen.landmarks.T)
    target = np.stack([(seen.pixels[:, 0] - cx) / fx, (seen.pixels[:, 1] - cy) / fy, seen.inverse])
    scale = np.empty((3, count))
    scale[0], scale[1] = fx / pixel_noise, fy / pixel_noise
    scale[2] = np.where(seen.measured, 1.0 / depth_noise, 0.0)
    jacobian = np.zeros((6, 3, count))
    image, errors = np.empty((3, count)), np.empty((2, count))
    for _ in range(_STEPS):
        p = pose[:3, :3] @ landmarks + pose[:3, 3:]
        ahead = p[2] > 0.01
        image[2] = 1.0 / np.where(ahead, p[2], 1.0)
        image[:2] = p[:2] * image[2]
        residuals = scale * (image - target)
        # By a small motion of the camera's frame: translation, then rotation (left perturbation).
        (x, y, inverse), by = image, jacobian
        by[0, 0] = by[1, 1] = inverse
        np.multiply(image, -inverse, out=by[2])
        by[4, 1] = x * y
        by[3, 0] = -by[4, 1]
        by[3, 1], by[4, 0] = -1.0 - y * y, 1.0 + x * x
        by[3, 2], by[4, 2] = -y * inverse, x * inverse
        by[5, 0], by[5, 1] = -y, x
        by *= scale
        np.hypot(residuals[0], residuals[1], out=errors[0])
        np.abs(residuals[2], out=errors[1])
        weights = _huber(errors) * ahead
        weighted = (by * weights[[0, 0, 1]]).reshape(6, -1)
        normal = weighted @ by.reshape(6, -1).T
        # In units of its own, as what landmarks in one column leave open is lost in rounding else.
        normal += np.diag(_DAMPING * np.diag(normal) + _DAMPING)
        gradient = weighted @ residuals.reshape(-1)
        if information is not None:
            normal += information
            gradient += information @ motion_between(start, pose)
        step = -np.linalg.solve(normal, gradient)
        pose = moved(pose, step)
        if np.abs(step).max() < _SMALL:
            break
    errors[0, ~ahead] = np.inf
    return Solution(pose, errors[0])


def moved(pose: Floats, step: Floats) -> Floats:
    """Return a pose, world to camera, after a small motion of the camera's frame, shape (6,)."""
    turn, there = cv2.Rodrigues(step[3:])[0], np.eye(4)
    there[:3, :3] = turn @ pose[:3, :3]
    there[:3, 3] = turn @ pose[:3, 3] + step[:3]
    return there


def motion_between(before: Floats, after: Floats) -> Floats:
    """Return the small motion that `moved` takes from one pose to another, shape (6,)."""
    between = after @ inverse(before)
    return np.concatenate([between[:3, 3], cv2.Rodrigues(between[:3, :3])[0].ravel()])


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
