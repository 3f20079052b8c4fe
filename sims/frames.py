"""Frames and quaternions on plain float tuples: MuJoCo's axes to ours and back.

MuJoCo's world is read as NWU (x north, y west, z up) and its bodies as FLU; ours are NED and FRD.
One is the other turned by half a turn about x, on both sides of a rotation alike, so a vector
changes the signs of y and z, and so does a quaternion's vector part. The same function goes both
ways.

Nothing here knows a simulator, and nothing makes a numpy array: one `np.cross` on 3-vectors costs
as much as a whole attitude controller written in floats.

Quaternions are (w, x, y, z), Hamilton's; see `events.geometry`. Equations: J. Solà, *Quaternion
kinematics for the error-state Kalman filter*, 2017, sections 1 and 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, copysign, cos, sin, sqrt

from events import Quaternion, Vector3

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""The rotation that leaves everything where it is."""


def half_turn_vector(vector: Vector3) -> Vector3:
    """Take a vector from NWU to NED, or from FLU to FRD, or back."""
    x, y, z = vector
    return (x, -y, -z)


def half_turn_quaternion(rotation: Quaternion) -> Quaternion:
    """Take a rotation FLU → NWU to the same rotation FRD → NED, or back."""
    w, x, y, z = rotation
    return (w, x, -y, -z)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return a ⊗ b: the rotation that applies `b` first, then `a`."""
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


def normalize(rotation: Quaternion) -> Quaternion:
    """Return the quaternion scaled to length one.

    Raises:
        ValueError: It is (nearly) zero, and so stands for no rotation.
    """
    w, x, y, z = rotation
    norm = sqrt(w * w + x * x + y * y + z * z)
    if not norm > 1e-12:
        raise ValueError(f"expected a quaternion longer than zero, found {rotation}")
    return (w / norm, x / norm, y / norm, z / norm)


def rotate(rotation: Quaternion, vector: Vector3) -> Vector3:
    """Take a vector from the child frame to the parent frame of a unit quaternion."""
    w, qx, qy, qz = rotation
    x, y, z = vector
    # v + 2w (q × v) + 2 q × (q × v), with t = 2 q × v
    tx = 2.0 * (qy * z - qz * y)
    ty = 2.0 * (qz * x - qx * z)
    tz = 2.0 * (qx * y - qy * x)
    return (
        x + w * tx + qy * tz - qz * ty,
        y + w * ty + qz * tx - qx * tz,
        z + w * tz + qx * ty - qy * tx,
    )


def rotate_inverse(rotation: Quaternion, vector: Vector3) -> Vector3:
    """Take a vector from the parent frame to the child frame of a unit quaternion."""
    w, x, y, z = rotation
    return rotate((w, -x, -y, -z), vector)


def from_euler(yaw: float, pitch: float, roll: float) -> Quaternion:
    """Return the rotation that turns about z by `yaw`, the new y by `pitch`, the new x by `roll`.

    Args:
        yaw: Radians; in NED clockwise from north seen from above.
        pitch: Radians; in FRD nose up.
        roll: Radians; in FRD right side down.

    Returns:
        Rotation from the body to the world (ZYX, the convention of aeronautics).
    """
    cy, sy = cos(0.5 * yaw), sin(0.5 * yaw)
    cp, sp = cos(0.5 * pitch), sin(0.5 * pitch)
    cr, sr = cos(0.5 * roll), sin(0.5 * roll)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def yaw_of(rotation: Quaternion) -> float:
    """Return the heading of the x axis, radians in [-π, π] (the yaw of `from_euler`).

    It has no meaning when x points straight up or down.
    """
    w, x, y, z = rotation
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def from_matrix(matrix: Sequence[Sequence[float]]) -> Quaternion:
    """Return the quaternion of a rotation matrix, with w ≥ 0.

    Args:
        matrix: Three rows of three; its columns are the child's axes in the parent frame.

    Returns:
        Unit quaternion, by the largest of the four components (S. W. Shepperd, 1978), so that
        no small number is ever divided by.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    if a + e + i > 0.0:
        s = 2.0 * sqrt(1.0 + a + e + i)
        q = (0.25 * s, (h - f) / s, (c - g) / s, (d - b) / s)
    elif a >= e and a >= i:
        s = 2.0 * sqrt(1.0 + a - e - i)
        q = ((h - f) / s, 0.25 * s, (b + d) / s, (c + g) / s)
    elif e >= i:
        s = 2.0 * sqrt(1.0 + e - a - i)
        q = ((c - g) / s, (b + d) / s, 0.25 * s, (f + h) / s)
    else:
        s = 2.0 * sqrt(1.0 + i - a - e)
        q = ((d - b) / s, (c + g) / s, (f + h) / s, 0.25 * s)
    sign = copysign(1.0, q[0])
    w, x, y, z = normalize((float(q[0]), float(q[1]), float(q[2]), float(q[3])))
    return (sign * w, sign * x, sign * y, sign * z)
