"""Bundle adjustment: poses of a few key frames and their landmarks, optimized together.

Gauss-Newton on reprojection errors with Huber weights and a little damping; landmarks are
eliminated by the Schur complement (B. Triggs et al., "Bundle adjustment: a modern synthesis",
2000, section 6.1). Dense, because a window of key frames is small.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.estimators.odometry.images import Floats

Indices = npt.NDArray[np.int64]

_HUBER = 2.0
"""Standard deviations beyond which a residual counts linearly."""
_DAMPING = 1e-4


def adjust(
    poses: Floats,
    landmarks: Floats,
    frame: Indices,
    landmark: Indices,
    pixels: Floats,
    matrix: Floats,
    *,
    fixed: int,
    noise: float,
    steps: int = 4,
) -> tuple[Floats, Floats, Floats]:
    """Return poses and landmarks that fit all observations better, and the remaining errors.

    Args:
        poses: World to camera, shape (k, 4, 4).
        landmarks: Points in the world, shape (l, 3).
        frame: Index of the pose of each observation, shape (m,).
        landmark: Index of its landmark, in ascending order, shape (m,): each has observations, at
            most one in each frame.
        pixels: Column and row of each observation, shape (m, 2).
        matrix: K, shape (3, 3).
        fixed: Number of first poses that stay; two of them fix position, rotation and scale.
        noise: Standard deviation of an observation, pixels.

    Returns:
        Poses, landmarks, and reprojection errors in pixels, shape (m,).
    """
    poses, landmarks = poses.copy(), landmarks.copy()
    free = len(poses) - fixed
    scale = np.array([matrix[0, 0], matrix[1, 1]]) / noise
    target = (pixels - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1])
    moves = frame >= fixed
    begins = np.flatnonzero(np.diff(landmark, prepend=-1))
    for _ in range(steps):
        residuals, by_pose, by_point, weights = linearise(
            poses, landmarks, frame, landmark, target, scale
        )
        weighted_pose = by_pose * weights[:, None, None]
        weighted_point = by_point * weights[:, None, None]
        h_point = np.add.reduceat(np.swapaxes(weighted_point, 1, 2) @ by_point, begins)
        g_point = np.add.reduceat(np.einsum("mij,mi->mj", weighted_point, residuals), begins)
        h_point += _DAMPING * np.eye(3) * (1.0 + np.trace(h_point, axis1=1, axis2=2))[:, None, None]
        inverse = np.linalg.inv(h_point)
        step_pose = np.zeros((free, 6))
        if free:
            k = frame[moves] - fixed
            h_pose, g_pose = np.zeros((free, 6, 6)), np.zeros((free, 6))
            for index in range(free):
                rows = frame == fixed + index
                weighted = weighted_pose[rows].reshape(-1, 6)
                h_pose[index] = weighted.T @ by_pose[rows].reshape(-1, 6)
                g_pose[index] = weighted.T @ residuals[rows].reshape(-1)
            cross = np.zeros((free, 6, len(landmarks), 3))
            cross[k, :, landmark[moves]] = np.swapaxes(weighted_pose[moves], 1, 2) @ by_point[moves]
            reduced = np.matmul(np.moveaxis(cross, 2, 0).reshape(-1, 6 * free, 3), inverse)
            reduced = np.moveaxis(reduced, 0, 1).reshape(6 * free, -1)
            flat = cross.reshape(6 * free, -1)
            normal = -reduced @ flat.T
            for index in range(free):
                block = slice(6 * index, 6 * index + 6)
                normal[block, block] += h_pose[index]
            normal += _DAMPING * np.diag(np.maximum(np.diag(normal), 1.0))
            right = g_pose.reshape(-1) - reduced @ g_point.reshape(-1)
            step_pose = -np.linalg.solve(normal, right).reshape(free, 6)
            g_point = g_point + (step_pose.reshape(-1) @ flat).reshape(-1, 3)
        landmarks = landmarks - np.einsum("lij,lj->li", inverse, g_point)
        for index in range(free):
            turn = Rotation.from_rotvec(step_pose[index, 3:]).as_matrix()
            pose = poses[fixed + index]
            pose[:3, :3] = turn @ pose[:3, :3]
            pose[:3, 3] = turn @ pose[:3, 3] + step_pose[index, :3]
    residuals, *_ = linearise(poses, landmarks, frame, landmark, target, scale)
    return poses, landmarks, np.asarray(noise * np.linalg.norm(residuals, axis=1))


def linearise(
    poses: Floats,
    landmarks: Floats,
    frame: Indices,
    landmark: Indices,
    target: Floats,
    scale: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the residuals of all observations, and their derivatives.

    Args:
        poses: World to camera, shape (k, 4, 4).
        landmarks: Points in the world, shape (l, 3).
        frame: Index of the pose of each observation, shape (m,).
        landmark: Index of its landmark, shape (m,).
        target: Each observation as a ray with z = 1, shape (m, 2).
        scale: Standard deviations in a unit of that, shape (2,).

    Returns:
        Residuals in standard deviations, shape (m, 2); their derivatives by a small motion of the
        camera's frame (translation, then rotation; left perturbation), shape (m, 2, 6), and by the
        landmark, shape (m, 2, 3); Huber's weights, shape (m,), 0 behind the camera.
    """
    turns, shifts = poses[frame, :3, :3], poses[frame, :3, 3]
    points = np.einsum("mij,mj->mi", turns, landmarks[landmark]) + shifts
    ahead = points[:, 2] > 1e-3
    inverse = 1.0 / np.where(ahead, points[:, 2], 1.0)
    x, y = points[:, 0] * inverse, points[:, 1] * inverse
    residuals = (np.stack([x, y], axis=1) - target) * scale
    zero = np.zeros_like(x)
    by_camera = np.stack(
        [
            np.stack([inverse, zero, -x * inverse], axis=1),
            np.stack([zero, inverse, -y * inverse], axis=1),
        ],
        axis=1,
    )
    by_camera *= scale[:, None]
    turning = np.stack(
        [
            np.stack([-x * y, 1.0 + x * x, -y], axis=1),
            np.stack([-1.0 - y * y, x * y, x], axis=1),
        ],
        axis=1,
    )
    turning *= scale[:, None]
    by_pose = np.concatenate([by_camera, turning], axis=2)
    by_point = by_camera @ turns
    size = np.linalg.norm(residuals, axis=1)
    weights = np.where(ahead, _HUBER / np.maximum(size, _HUBER), 0.0)
    return residuals, by_pose, by_point, weights
