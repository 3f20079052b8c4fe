"""Changes of axes, on plain float tuples: NED, NWU and ENU worlds, FRD and FLU bodies, optical.

Ours are NED, FRD and optical (x right, y down, z forward); see `events.geometry`. MuJoCo's worlds
and data sets are NWU, ROS's world is ENU and its bodies FLU (REP 103); optical axes are the same
everywhere. Each change is a half turn, so the same function of vectors goes both ways.
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from events.rotations import inverse, multiply

OPTICAL_TO_FRD: Quaternion = (0.5, 0.5, 0.5, 0.5)
"""Rotation from the optical frame of a camera to its body frame, forward, right, down."""

OPTICAL_TO_FLU: Quaternion = (0.5, -0.5, 0.5, -0.5)
"""Rotation from the optical frame of a camera to its body frame, forward, left, up."""


def flip_yz(vector: Vector3) -> Vector3:
    """Take a vector from NED to NWU, or from FRD to FLU, or back: y and z change their signs."""
    x, y, z = vector
    return (x, -y, -z)


def flip_yz_rotation(rotation: Quaternion) -> Quaternion:
    """Take a rotation FRD → NED to the same rotation FLU → NWU, or back."""
    w, x, y, z = rotation
    return (w, x, -y, -z)


def rotation_to_nwu(rotation: Quaternion) -> Quaternion:
    """Take a rotation from any child frame to NED to the one from that frame to NWU."""
    w, x, y, z = rotation
    return (-x, w, -z, y)  # (0, 1, 0, 0) ⊗ rotation


def rotation_to_ned(rotation: Quaternion) -> Quaternion:
    """Take a rotation from any child frame to NWU to the one from that frame to NED."""
    w, x, y, z = rotation
    return (x, -w, z, -y)  # the inverse of (0, 1, 0, 0) ⊗ rotation


Axes = Literal["world", "body", "optical"]
"""Kind of a frame: NED here is ENU in ROS, FRD here is FLU in ROS, optical is the same."""

_S = sqrt(0.5)
_TURNS: dict[Axes, Quaternion] = {
    "world": (0.0, _S, _S, 0.0),
    "body": (0.0, 1.0, 0.0, 0.0),
    "optical": (1.0, 0.0, 0.0, 0.0),
}
_MATRICES: dict[Axes, npt.NDArray[np.float64]] = {
    "world": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "body": np.diag([1.0, -1.0, -1.0]),
    "optical": np.eye(3),
}


def axes_of(frame_id: str) -> Axes:
    """Return the kind of a frame by its name: ours, or ROS's (REP 103's suffix)."""
    if frame_id == "map":
        return "world"
    return "optical" if frame_id.endswith(("_optical", "_optical_frame")) else "body"


def convert_vector(axes: Axes, vector: Vector3) -> Vector3:
    """Take a vector in such a frame from our axes to ROS's, or back."""
    x, y, z = vector
    if axes == "world":
        return (y, x, -z)
    return (x, -y, -z) if axes == "body" else vector


def convert_rotation(parent: Axes, child: Axes, rotation: Quaternion) -> Quaternion:
    """Take a rotation from child to parent from our axes to ROS's, or back.

    Args:
        parent: Kind of the frame it leads to.
        child: Kind of the frame it comes from.
        rotation: Unit quaternion; the result is one too.
    """
    if parent == "world" and child == "body":  # the one that is needed hundreds of times a second
        w, x, y, z = rotation
        return (_S * (w + z), _S * (x + y), _S * (x - y), _S * (w - z))
    return multiply(multiply(_TURNS[parent], rotation), inverse(_TURNS[child]))


def convert_points(axes: Axes, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Take points, shape (n, 3), from our axes to ROS's, or back."""
    if axes == "optical":
        return points
    turned = points[:, [1, 0, 2]] if axes == "world" else points.copy()
    turned[:, 2] *= -1.0
    if axes == "body":
        turned[:, 1] *= -1.0
    return turned


def convert_covariance(axes: Axes, covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Take the covariance of a pose, or of a position, from our axes to ROS's, or back.

    Args:
        axes: Kind of the parent frame, about whose fixed axes the angles are.
        covariance: Row-major; 36 numbers, (x, y, z, roll, pitch, yaw), or 9, (x, y, z).
    """
    size = 3 if covariance.size == 9 else 6
    turn = np.kron(np.eye(size // 3), _MATRICES[axes])
    return (turn @ covariance.reshape(size, size) @ turn.T).ravel()
