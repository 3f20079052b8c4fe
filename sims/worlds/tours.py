"""A standard flight through each world: a closed path that keeps its distance from everything."""

from __future__ import annotations

import math

from events.base import Vector3

CLEARANCE = 0.8
"""Least distance (metres) of the straight lines between a tour's points from every solid."""

TOURS: dict[str, tuple[Vector3, ...]] = {
    # Round the hall, through the brick arch and the timber portal.
    "hall": (
        (0.0, 0.0, -1.5), (4.4, 0.2, -1.5), (6.0, -2.0, -1.7), (5.4, -4.1, -1.6),
        (0.6, -4.2, -1.5), (-2.4, -4.0, -1.3), (-5.6, -3.9, -1.7), (-6.4, -1.6, -2.0),
        (-4.4, 0.0, -1.8), (-5.0, 3.4, -1.6), (-3.2, 4.25, -1.5), (1.6, 4.25, -1.5),
        (5.2, 3.9, -1.4), (6.1, 1.8, -1.8), (3.9, 0.6, -2.0), (0.4, 1.0, -1.9), (-2.6, 0.3, -1.7),
    ),
    # Round the yard, through the stone arch and the brick arch.
    "yard": (
        (0.0, 0.0, -1.5), (2.9, 1.4, -1.6), (6.1, 3.2, -1.8), (6.5, 6.5, -1.6), (3.2, 7.6, -1.5),
        (-2.9, 6.1, -1.5), (-6.5, 6.8, -1.7), (-7.9, 2.9, -2.0), (-5.6, -0.4, -1.7),
        (-6.5, -4.3, -1.5), (-4.2, -7.05, -1.5), (0.7, -5.8, -1.5), (4.3, -6.8, -1.7),
        (5.8, -3.2, -1.9), (2.5, -2.2, -1.7),
    ),
    # Once round the block.
    "corridor": (
        (0.0, 0.0, -1.4), (5.2, 0.2, -1.3), (10.3, -0.1, -1.4), (10.5, -4.0, -1.5),
        (10.3, -7.7, -1.5), (5.2, -7.9, -1.3), (0.0, -7.6, -1.5), (-5.2, -8.0, -1.4),
        (-10.3, -7.7, -1.6), (-10.5, -4.0, -1.5), (-10.3, -0.1, -1.4), (-5.2, -0.2, -1.4),
    ),
    # Between the stems.
    "forest": (
        (0.0, 0.0, -1.5), (3.0, 0.5, -1.5), (5.5, 2.5, -1.7), (7.5, 5.0, -1.6), (6.0, 7.5, -1.8),
        (2.5, 6.5, -1.6), (-0.5, 5.0, -1.5), (-3.5, 6.5, -1.6), (-6.5, 6.5, -1.8),
        (-8.0, 3.5, -1.9), (-6.0, 0.5, -1.7), (-7.5, -2.5, -1.5), (-6.0, -5.5, -1.6),
        (-3.0, -6.0, -1.8), (-0.5, -4.0, -1.6), (2.5, -5.0, -1.5), (4.5, -3.0, -1.6),
        (2.5, -1.5, -1.5),
    ),
    # Round the desks, along the windows and the glass.
    "office": (
        (0.0, 0.0, -1.5), (2.6, -0.3, -1.5), (5.1, -0.6, -1.6), (5.4, -4.5, -1.7),
        (6.2, -4.3, -1.6), (6.2, -1.2, -1.5), (5.9, 1.7, -1.7), (3.4, 2.4, -1.6), (3.3, 4.5, -1.5),
        (0.4, 4.7, -1.6), (-2.6, 4.6, -1.7), (-4.0, 2.8, -1.6), (-4.0, 0.3, -1.5),
        (-6.6, -0.1, -1.6), (-6.7, -3.0, -1.6), (-5.4, -4.3, -1.5), (-2.6, -4.2, -1.4),
        (1.4, -4.3, -1.6), (0.2, -3.2, -1.6), (-0.4, -1.6, -1.6),
    ),
}  # fmt: skip
TOURS["night"] = TOURS["yard"]
"""Each world's tour: waypoints in NED (metres), in order; from the last it goes back to the first.
Each is about 50 to 60 m long."""


def tour_length(name: str) -> float:
    """Return the length of a world's tour, once round, in metres."""
    points = TOURS[name]
    return sum(math.dist(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True))
