"""Poses as transforms: a position and an orientation, or a matrix of shape (4, 4).

A pose of B in A is the transform that takes coordinates in B to coordinates in A.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events.base import Quaternion, Vector3
from events.rotations import inverse as inverse_rotation
from events.rotations import multiply, rotate

Floats = npt.NDArray[np.float64]

Pose = tuple[Vector3, Quaternion]
"""Position (metres) and orientation (w, x, y, z) in the parent frame."""


def pose_matrix(position: Vector3, orientation: Quaternion) -> Floats:
    """Return a pose (metres; w, x, y, z) as the transform from child to parent, shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
    matrix[:3, 3] = position
    return matrix


def pose_tuples(matrix: npt.NDArray[Any]) -> Pose:
    """Return a transform, shape (4, 4), as position (metres) and orientation (w ≥ 0, x, y, z)."""
    x, y, z = matrix[:3, 3].tolist()
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True, scalar_first=True)
    qw, qx, qy, qz = quaternion.tolist()
    return (x, y, z), (qw, qx, qy, qz)


def inverse(matrix: Floats) -> Floats:
    """Return the inverse of a rigid transform, shape (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return result


def relative(base: Pose, pose: Pose) -> Pose:
    """Return a pose in the frame that `base` is the pose of; both are in one parent frame."""
    (bx, by, bz), (px, py, pz) = base[0], pose[0]
    back = inverse_rotation(base[1])
    return rotate(back, (px - bx, py - by, pz - bz)), multiply(back, pose[1])
