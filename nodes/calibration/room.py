"""The room in which a rig is proven: black walls, and white spheres in every direction.

Its surfaces are known as numbers, so what a ray meets is computed here and not by a renderer.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

CENTRE = np.array([0.0, 0.0, -1.5])
"""About where the vehicle flies, metres in ``map``."""

LOW, HIGH = np.array([-6.0, -6.0, -5.0]), np.array([6.0, 6.0, 0.0])
"""Corners of the room, metres in ``map``: the floor is at 0, the ceiling at -5."""

NEAREST = 0.45
"""Metres along the optical axis within which only the vehicle itself can be seen."""

_COUNT = 130


def spheres(angle: float) -> tuple[Floats, Floats]:
    """Return the spheres' centres (metres in ``map``, shape (n, 3)) and radii (metres, (n,)).

    They lie on a spiral of equal areas, seen from the room's centre, before the walls.

    Args:
        angle: Half of the angle that each takes up from there, radians.
    """
    number = np.arange(_COUNT) + 0.5
    down = 1.0 - 2.0 * number / _COUNT
    around = np.pi * (1.0 + 5.0**0.5) * number
    flat = np.sqrt(1.0 - down**2)
    direction = np.column_stack([flat * np.cos(around), flat * np.sin(around), down])
    # As far as it clears every wall by half its radius.
    slow = np.maximum(np.hstack([direction, -direction]), 0.0) + 1.5 * np.sin(angle)
    distance = (np.hstack([HIGH - CENTRE, CENTRE - LOW]) / slow).min(axis=1)
    return CENTRE + direction * distance[:, None], np.sin(angle) * distance


def mjcf(angle: float) -> str:
    """Return the room as a world file; x is north, y west, z up there."""
    walls = []
    for axis, (low, high) in enumerate(zip(LOW, HIGH, strict=True)):
        for side, face in ((-1.0, low), (1.0, high)):
            place, size = (LOW + HIGH) / 2.0, (HIGH - LOW) / 2.0 + 0.2
            place[axis], size[axis] = face + side * 0.1, 0.1
            walls.append(f'<geom type="box" size="{_text(size)}" pos="{_text(place, -1)}"/>')
    balls = [
        f'<geom type="sphere" size="{radius:.9f}" pos="{_text(centre, -1)}" material="white" '
        'rgba="1 1 1 1" contype="0" conaffinity="0"/>'
        for centre, radius in zip(*spheres(angle), strict=True)
    ]
    return f"""<mujoco model="calibration room">
  <option timestep="0.001"/>
  <visual>
    <quality numslices="96" numstacks="96" offsamples="8"/>
    <headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <default><geom rgba="0 0 0 1"/></default>
  <asset><material name="white" rgba="1 1 1 1" emission="1" specular="0"/></asset>
  <worldbody>
    {"".join(walls)}
    {"".join(balls)}
  </worldbody>
</mujoco>
"""


def hits(angle: float, origins: Floats, rays: Floats) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return what rays meet first.

    Args:
        angle: As of `spheres`.
        origins: Metres in ``map``, within the room, shape (n, 3).
        rays: Unit directions in ``map``, shape (n, 3).

    Returns:
        Distances, metres, shape (n,); and what is met: the number of a sphere, or below 0 a wall.
    """
    with np.errstate(divide="ignore"):
        faces = np.where(rays > 0, HIGH - origins, LOW - origins) / rays
    wall = faces.argmin(axis=1)
    best, what = (
        faces.min(axis=1),
        -1 - wall - 3 * (np.take_along_axis(rays, wall[:, None], 1)[:, 0] > 0),
    )
    for number, (centre, radius) in enumerate(zip(*spheres(angle), strict=True)):
        to = centre - origins
        along = (to * rays).sum(axis=1)
        inside = radius**2 - ((to * to).sum(axis=1) - along**2)
        distance = along - np.sqrt(np.maximum(inside, 0.0))
        nearer = (inside > 0.0) & (distance > 0.0) & (distance < best)
        best, what = np.where(nearer, distance, best), np.where(nearer, number, what)
    return best, what


def _text(vector: Floats, sign: int = 1) -> str:
    x, y, z = vector
    return f"{x:.9f} {sign * y:.9f} {sign * z:.9f}"
