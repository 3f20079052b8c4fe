"""Unit quaternions as plain float tuples: product, inverse, rotation of vectors, angles, slerp.

A quaternion is ``(w, x, y, z)``, Hamilton's, everywhere in this project; it rotates vectors from
the child frame to the parent frame. Equations: J. Solà, *Quaternion kinematics for the error-state
Kalman filter*, 2017, sections 1 and 2.

Nothing here makes a numpy array: one `np.cross` of two 3-vectors costs as much as a whole attitude
controller written in floats. Many rotations at once are scipy's
(``Rotation.from_quat(…, scalar_first=True)``); poses as matrices are in `events.poses`, and changes
of axes (NED, ENU, NWU, FRD, FLU, optical) in `events.frames`.
"""

from __future__ import annotations

from math import acos, atan2, cos, sin, sqrt

from events.base import Quaternion, Vector3

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""The rotation that changes nothing."""


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


def inverse(rotation: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion, which is its conjugate."""
    w, x, y, z = rotation
    return (w, -x, -y, -z)


def normalize(rotation: Quaternion) -> Quaternion:
    """Return the quaternion scaled to length one.

    Raises:
        ValueError: Its length is not between 0.001 and 1000, so that it is no rotation.
    """
    w, x, y, z = rotation
    norm = sqrt(w * w + x * x + y * y + z * z)
    if not 1e-3 < norm < 1e3:
        raise ValueError(f"expected a quaternion of length one, found {rotation}")
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


def cross(a: Vector3, b: Vector3) -> Vector3:
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation by `yaw` about z, then `pitch` about the new y, then `roll` about x.

    This is the order of aeronautics (intrinsic ZYX), and ROS's roll, pitch, yaw (REP 103).

    Args:
        roll: Radians; in FRD right side down.
        pitch: Radians; in FRD nose up.
        yaw: Radians; in NED clockwise from north seen from above.

    Returns:
        Rotation from the body to the world.
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


def from_yaw(yaw: float) -> Quaternion:
    """Return the rotation about z by `yaw` radians: a level body in the world."""
    return (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw))


def yaw_of(rotation: Quaternion) -> float:
    """Return the heading of the x axis, radians in [-π, π] (the yaw of `from_rpy`).

    It has no meaning when x points straight up or down.
    """
    w, x, y, z = rotation
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the rotation from one orientation to another, radians in [0, π].

    It is taken from both parts of the quaternion between them, because an arc cosine would lose
    small angles.
    """
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw + ax * bx + ay * by + az * bz
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by - ay * bw - az * bx + ax * bz
    z = aw * bz - az * bw - ax * by + ay * bx
    return 2.0 * atan2(sqrt(x * x + y * y + z * z), abs(w))


def slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """Return the rotation that lies a share of the way from `a` to `b`, along the shorter arc.

    K. Shoemake, "Animating rotation with quaternion curves", 1985.

    Args:
        a: Unit quaternion, the result for a share of 0.
        b: Unit quaternion; the result for a share of 1 is the same rotation.
        share: Number in [0, 1].
    """
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if cosine < 0.0 else 1.0
    angle = acos(min(sign * cosine, 1.0))
    first, second = 1.0 - share, sign * share
    if angle > 1e-6:  # below, sines are their angles, and there is nothing to divide by
        first, second = sin(first * angle) / sin(angle), sign * sin(share * angle) / sin(angle)
    w, x, y, z = (first * p + second * q for p, q in zip(a, b, strict=True))
    return (w, x, y, z)
