"""Axes: ours (NED, FRD) to those of ROS (ENU, FLU; REP 103) and back, on plain float tuples.

Optical axes are the same on both sides. A world changes x for y and the sign of z; a body changes
the signs of y and z. Both are half turns, so the same function goes both ways.

Quaternions are (w, x, y, z) here, on both sides; messages name their parts.
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3

Axes = Literal["world", "body", "optical"]
"""NED or ENU; FRD or FLU; right, down, forward on both sides."""

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

OPTICAL_IN_LINK: Quaternion = (0.5, -0.5, 0.5, -0.5)
"""Rotation from a camera's optical frame to its FLU body (REP 103's suffix ``_optical``)."""


def axes_of(frame_id: str) -> Axes:
    """Return how the axes of a frame lie by its name: ours, or ROS's (REP 103's suffix)."""
    if frame_id == "map":
        return "world"
    return "optical" if frame_id.endswith(("_optical", "_optical_frame")) else "body"


def turn_vector(axes: Axes, vector: Vector3) -> Vector3:
    """Take a vector in such a frame to the other side's axes."""
    x, y, z = vector
    if axes == "world":
        return (y, x, -z)
    return (x, -y, -z) if axes == "body" else vector


def turn_rotation(parent: Axes, child: Axes, rotation: Quaternion) -> Quaternion:
    """Take a rotation from child to parent to the other side's axes.

    Args:
        parent: Axes of the frame it leads to.
        child: Axes of the frame it comes from.
        rotation: Unit quaternion; the result is one too.
    """
    if parent == "world" and child == "body":  # the one that is needed hundreds of times a second
        w, x, y, z = rotation
        return (_S * (w + z), _S * (x + y), _S * (x - y), _S * (w - z))
    turned = multiply(_TURNS[parent], rotation)
    return multiply(turned, conjugate(_TURNS[child]))


def turn_points(axes: Axes, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Take points, shape (n, 3), to the other side's axes."""
    if axes == "optical":
        return points
    turned = points[:, [1, 0, 2]] if axes == "world" else points.copy()
    turned[:, 2] *= -1.0
    if axes == "body":
        turned[:, 1] *= -1.0
    return turned


def turn_covariance(axes: Axes, covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Take the covariance of a pose to the other side's axes.

    Args:
        axes: Of the parent frame, about whose fixed axes the angles are.
        covariance: 36 numbers, row-major, (x, y, z, roll, pitch, yaw).
    """
    turn = np.kron(np.eye(2), _MATRICES[axes])
    return (turn @ covariance.reshape(6, 6) @ turn.T).ravel()


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation that applies `b` first, then `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(rotation: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    w, x, y, z = rotation
    return (w, -x, -y, -z)


def rotate(rotation: Quaternion, vector: Vector3) -> Vector3:
    """Take a vector from the child frame to the parent frame of a unit quaternion."""
    _, x, y, z = multiply(multiply(rotation, (0.0, *vector)), conjugate(rotation))
    return (x, y, z)


def relative(
    base: tuple[Vector3, Quaternion], pose: tuple[Vector3, Quaternion]
) -> tuple[Vector3, Quaternion]:
    """Return a pose in the frame that `base` is the pose of; both in one parent."""
    (bx, by, bz), (px, py, pz) = base[0], pose[0]
    back = conjugate(base[1])
    return rotate(back, (px - bx, py - by, pz - bz)), multiply(back, pose[1])


def unit(rotation: Quaternion) -> Quaternion:
    """Return a quaternion scaled to length one.

    Raises:
        ValueError: It stands for no rotation.
    """
    w, x, y, z = rotation
    norm = sqrt(w * w + x * x + y * y + z * z)
    if not 1e-3 < norm < 1e3:
        raise ValueError(f"expected a quaternion of length one, found {rotation}")
    return (w / norm, x / norm, y / norm, z / norm)
