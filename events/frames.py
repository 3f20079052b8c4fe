"""Rotations, changes of axes, and places on the earth, on plain float tuples.

A quaternion is ``(w, x, y, z)``, Hamilton's, everywhere in this project; it rotates vectors from
the child frame to the parent frame. Equations: J. Solà, *Quaternion kinematics for the error-state
Kalman filter*, 2017, sections 1 and 2. Nothing here makes a numpy array: one `np.cross` of two
3-vectors costs as much as a whole attitude controller written in floats. Many rotations at once are
scipy's (``Rotation.from_quat(…, scalar_first=True)``).

Axes: ours are NED, FRD and optical (x right, y down, z forward). MuJoCo's worlds and data sets are
NWU, ROS's world is ENU and its bodies FLU (REP 103); optical axes are the same everywhere. Each
change is a half turn, so the same function of vectors goes both ways.

Places: between ``map`` (NED at an origin) and WGS 84's latitude and longitude, through
earth-centred, earth-fixed coordinates (ECEF), so without approximation. A run's ``map`` is the
plane that touches the ellipsoid's parallel surface at the origin.
"""

from __future__ import annotations

import functools
from math import acos, atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)  # identity rotation


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product a ⊗ b: the rotation by `b`, then by `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def inverse(rotation: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion, its conjugate."""
    w, x, y, z = rotation
    return (w, -x, -y, -z)


def normalize(rotation: Quaternion) -> Quaternion:
    """Return the quaternion scaled to length 1; raise `ValueError` outside 0.001 to 1000."""
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

    This is the order of aeronautics (intrinsic ZYX), and ROS's roll, pitch, yaw (REP 103): from the
    body to the world. Radians; in FRD right side down and nose up, in NED clockwise from above.
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
    """Return the heading of the x axis, radians in [-π, π]; meaningless if x is vertical."""
    w, x, y, z = rotation
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the rotation between two orientations, radians in [0, π].

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
    """Return the spherical linear interpolation from `a` to `b`, along the shorter arc.

    K. Shoemake, "Animating rotation with quaternion curves", 1985. `share` is in [0, 1].
    """
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if cosine < 0.0 else 1.0
    angle = acos(min(sign * cosine, 1.0))
    first, second = 1.0 - share, sign * share
    if angle > 1e-6:  # below, sines are their angles, and there is nothing to divide by
        first, second = sin(first * angle) / sin(angle), sign * sin(share * angle) / sin(angle)
    w, x, y, z = (first * p + second * q for p, q in zip(a, b, strict=True))
    return (w, x, y, z)


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
    """Convert the parent frame of a rotation from NED to NWU, for any child frame."""
    w, x, y, z = rotation
    return (-x, w, -z, y)  # (0, 1, 0, 0) ⊗ rotation


def rotation_to_ned(rotation: Quaternion) -> Quaternion:
    """Convert the parent frame of a rotation from NWU to NED, for any child frame."""
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
    """Take a rotation from child to parent from our axes to ROS's, or back."""
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


Geodetic = tuple[float, float, float]
"""Latitude and longitude, degrees north and east, and metres above the WGS 84 ellipsoid."""

SEMI_MAJOR = 6378137.0  # metres (NIMA TR8350.2, table 3.1)

FLATTENING = 1.0 / 298.257223563

_E2 = FLATTENING * (2.0 - FLATTENING)


def to_ecef(place: Geodetic) -> Vector3:
    """Return earth-centred, earth-fixed coordinates, metres."""
    latitude, longitude = radians(place[0]), radians(place[1])
    normal = SEMI_MAJOR / sqrt(1.0 - _E2 * sin(latitude) ** 2)
    across = (normal + place[2]) * cos(latitude)
    up = (normal * (1.0 - _E2) + place[2]) * sin(latitude)
    return (across * cos(longitude), across * sin(longitude), up)


def from_ecef(point: Vector3) -> Geodetic:
    """Return a place by its earth-centred coordinates (metres), to a micrometre below 1000 km.

    B. R. Bowring, "Transformation from spatial to geographical coordinates", 1976, two rounds.
    """
    x, y, z = point
    across = hypot(x, y)
    reduced = atan2(z, (1.0 - FLATTENING) * across)
    for _ in range(2):
        latitude = atan2(
            z + _E2 / (1.0 - FLATTENING) * SEMI_MAJOR * sin(reduced) ** 3,
            across - _E2 * SEMI_MAJOR * cos(reduced) ** 3,
        )
        reduced = atan2((1.0 - FLATTENING) * sin(latitude), cos(latitude))
    normal = SEMI_MAJOR / sqrt(1.0 - _E2 * sin(latitude) ** 2)
    height = across * cos(latitude) + z * sin(latitude) - SEMI_MAJOR**2 / normal
    return (degrees(latitude), degrees(atan2(y, x)), height)


def to_geodetic(position: Vector3, origin: Geodetic) -> Geodetic:
    """Return where a position in ``map`` (metres NED) is, for an origin of ``map``."""
    (north, east, down), start = _frame(origin)
    n, e, d = position
    x, y, z = (
        begin + (n * along + e * across + d * below)
        for begin, along, across, below in zip(start, north, east, down, strict=True)
    )
    return from_ecef((x, y, z))


def from_geodetic(place: Geodetic, origin: Geodetic) -> Vector3:
    """Return a place's position in ``map``, metres NED, for an origin of ``map``."""
    apart = [a - b for a, b in zip(to_ecef(place), to_ecef(origin), strict=True)]
    x, y, z = (sum(a * b for a, b in zip(axis, apart, strict=True)) for axis in _axes(origin))
    return (x, y, z)


@functools.lru_cache(maxsize=16)
def _frame(origin: Geodetic) -> tuple[tuple[Vector3, Vector3, Vector3], Vector3]:
    return _axes(origin), to_ecef(origin)


def _axes(origin: Geodetic) -> tuple[Vector3, Vector3, Vector3]:
    latitude, longitude = radians(origin[0]), radians(origin[1])
    sp, cp, sl, cl = sin(latitude), cos(latitude), sin(longitude), cos(longitude)
    return (-sp * cl, -sp * sl, cp), (-sl, cl, 0.0), (-cp * cl, -cp * sl, -sp)
