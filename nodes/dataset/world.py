"""The world of a data set: z up, as their readers expect it.

Ours is NED; north, west, up (NWU) is the same turned by half a turn about x. Only the world's side
of a pose turns: bodies stay FRD and cameras optical, so measurements and mountings stay as they
are, and a body at rest measures minus its gravity in either world.
"""

from __future__ import annotations

from events import Quaternion, Vector3

WORLD = "world: x north, y west, z up; origin on the ground"
"""For the heads of files."""


def vector_to_nwu(vector: Vector3) -> Vector3:
    """Take a vector from NED to NWU."""
    x, y, z = vector
    return (x, -y, -z)


def rotation_to_nwu(rotation: Quaternion) -> Quaternion:
    """Take a rotation from a child frame to NED to the rotation from that frame to NWU."""
    w, x, y, z = rotation
    return (-x, w, -z, y)  # (0, 1, 0, 0) ⊗ rotation


def to_parent(rotation: Quaternion, vector: Vector3) -> Vector3:
    """Take a vector from the child to the parent frame of a unit quaternion."""
    w, qx, qy, qz = rotation
    x, y, z = vector
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    return (
        x + w * tx + qy * tz - qz * ty,
        y + w * ty + qz * tx - qx * tz,
        z + w * tz + qx * ty - qy * tx,
    )
