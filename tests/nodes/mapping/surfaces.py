"""How far points are from what there is to see in a world, by rays of the physics engine."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from sims.worlds import load_world

Array = npt.NDArray[np.float64]

LOOKS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
"""Geoms that are drawn: group 0."""
DIRECTIONS = 200


@cache
def world(name: str) -> tuple[Any, Any]:
    """Return a built-in world, with nobody in it."""
    model = load_world(name).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def all_round(count: int) -> Array:
    """Return unit vectors in all directions, evenly, shape (count, 3): a Fibonacci lattice."""
    number = np.arange(count) + 0.5
    height = 1.0 - 2.0 * number / count
    angle = number * math.pi * (1.0 + 5.0**0.5)
    around = np.sqrt(1.0 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)


def distances(name: str, points: npt.NDArray[Any]) -> Array:
    """Return each point's distance from the nearest surface, metres, shape (n,).

    The shortest ray is never shorter than that distance. From a flat surface it is longer by 1 in
    50 at most: of 200 directions one is within 11 degrees of any.

    Args:
        name: The world's.
        points: Metres in ``map`` (NED), shape (n, 3).
    """
    model, data = world(name)
    rays = all_round(DIRECTIONS)
    flat, geoms, reach = rays.ravel(), np.empty(len(rays), np.int32), np.empty(len(rays))
    ranges = np.empty(len(points))
    for row, point in enumerate(np.asarray(points, np.float64) * (1.0, -1.0, -1.0)):
        mujoco.mj_multiRay(
            model, data, point, flat, LOOKS, True, -1, geoms, reach, None, len(rays), 1e6
        )
        hits = reach[reach >= 0.0]
        ranges[row] = hits.min() if len(hits) else math.inf
    return ranges
