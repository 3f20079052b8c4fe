"""Poses from landmarks, by robust Gauss-Newton with Huber's weights.

Residuals are two pixels and the inverse depth, in units of noise (R. Mur-Artal and J. D. Tardós,
"ORB-SLAM2", IEEE T-RO 2017, section III-A).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events.geometry import inverse
from nodes.estimators.images import Floats
from nodes.estimators.surfaces import Surfaces

_HUBER = 2.0  # Huber threshold of a residual, standard deviations
_STEPS = 8
_SMALL = 1e-7
_DAMPING = 1e-9  # damping of each motion, relative to its own information


def solve_pose(
    landmarks: Floats,  # metres in the world, shape (n, 3), n > 3 (or less with `information`)
    pixels: Floats,  # theirs: column and row, shape (n, 2)
    start: Floats,  # initial pose, world to camera, shape (4, 4)
    matrix: Floats,  # K, shape (3, 3)
    pixel_noise: float,  # standard deviation of a coordinate, pixels
    read: Surfaces | None = None,  # their inverse depth, where measured
    depth_noise: float = 1.0,  # standard deviation of inverse depth, 1/m
    information: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Return the pose with the least sum of robust squared residuals.

    Args:
        information: Inverse covariance of the initial pose, if known: of a small motion of the
            camera's frame, translation, then rotation, shape (6, 6).

    Returns:
        World to camera, shape (4, 4), and the landmarks' reprojection errors in standard
        deviations, shape (n,).
    """
    fx, fy, cx, cy = intrinsics(matrix)
    pose, count = start.copy(), len(pixels)
    # In rows of contiguous memory: coordinates, and derivatives of each by the six motions.
    landmarks = np.ascontiguousarray(landmarks.T)
    target, scale = np.zeros((3, count)), np.zeros((3, count))
    target[0], target[1] = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    scale[0], scale[1] = fx / pixel_noise, fy / pixel_noise
    if read is not None:
        target[2], scale[2] = read.inverse, read.continuous / depth_noise
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
        weights = huber(errors, _HUBER) * ahead
        weighted = (by * weights[[0, 0, 1]]).reshape(6, -1)
        normal = weighted @ by.reshape(6, -1).T
        # Relative to the diagonal, else rounding hides what landmarks in one column leave open.
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
    return pose, errors[0]


def moved(pose: Floats, step: Floats) -> Floats:
    """Return a pose, world to camera, after a small motion of the camera's frame, shape (6,)."""
    turn = cv2.Rodrigues(step[3:])[0]
    return transform(turn @ pose[:3, :3], turn @ pose[:3, 3] + step[:3])


def motion_between(before: Floats, after: Floats) -> Floats:
    """Return the small motion from a pose to another, as taken by `moved`, shape (6,)."""
    between = after @ inverse(before)
    return np.concatenate([between[:3, 3], cv2.Rodrigues(between[:3, :3])[0].ravel()])


def huber(errors: Floats, threshold: float) -> Floats:
    """Return Huber's weights of errors, both of one shape."""
    return np.asarray(threshold / np.maximum(errors, threshold))


def intrinsics(matrix: Floats) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of K, shape (3, 3)."""
    return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]


def rays(pixels: Floats, matrix: Floats) -> Floats:
    """Return directions in the optical frame with z = 1, shape (n, 3), of pixels, shape (n, 2)."""
    fx, fy, cx, cy = intrinsics(matrix)
    return np.stack(
        [(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1
    )


def transform(rotation: npt.NDArray[Any], translation: npt.NDArray[Any]) -> Floats:
    """Return the transform, shape (4, 4), of a rotation, shape (3, 3), and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    return pose
