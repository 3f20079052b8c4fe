"""The pose that explains where landmarks are seen, and how far away: robust Gauss-Newton.

Residuals of each landmark are its two pixels and its inverse depth, each in units of its noise, as
a stereo camera's three coordinates would be (R. Mur-Artal and J. D. Tardós, "ORB-SLAM2", IEEE
T-RO 2017, section III-A); weights are Huber's.
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.visual_odometry.tracker import Floats

_HUBER = 2.0
"""Standard deviations beyond which a residual counts linearly."""
_STEPS = 8
_SMALL = 1e-7


class Observations(msgspec.Struct, frozen=True, eq=False):
    """Landmarks as one picture shows them.

    Attributes:
        landmarks: Metres in the world, shape (n, 3).
        pixels: Column and row, shape (n, 2).
        inverse: Measured inverse depth, 1/m, shape (n,).
        measured: Where there is one, shape (n,).
    """

    landmarks: Floats
    pixels: Floats
    inverse: Floats
    measured: npt.NDArray[np.bool_]

    def take(self, rows: npt.NDArray[np.bool_]) -> Observations:
        """Return some of them."""
        return Observations(
            self.landmarks[rows], self.pixels[rows], self.inverse[rows], self.measured[rows]
        )


class Solution(msgspec.Struct, frozen=True, eq=False):
    """A pose and how well it explains each landmark.

    Attributes:
        pose: World to camera, shape (4, 4).
        errors: Reprojection errors in standard deviations, shape (n,).
    """

    pose: Floats
    errors: Floats


def solve_pose(
    seen: Observations,
    start: Floats,
    camera: tuple[float, ...],
    pixel_noise: float,
    depth_noise: float,
) -> Solution:
    """Return the pose that minimises the sum of robust squared residuals.

    Args:
        seen: At least four landmarks.
        start: World to camera, to begin with, shape (4, 4).
        camera: fx, fy, cx, cy.
        pixel_noise: Standard deviation of a coordinate, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m.
    """
    fx, fy, cx, cy = camera
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
