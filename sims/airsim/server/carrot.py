"""A point that runs ahead of a vehicle along a path, for the vehicle to fly to.

The method is "pure pursuit" (R. C. Coulter, CMU-RI-TR-92-01, 1992); the rules of look-ahead
and ending are those of AirSim's ``moveOnPath``.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence

from events import Vector3

CLOSE = 0.5
"""Metres from the end within which a vehicle is not steered along the path any more."""
_WINDOW = 64
"""Segments ahead among which the vehicle's place is sought, which bounds the work."""
_SPACING = 0.05
"""Metres below which the next corner of a path is left out."""


def lookahead_of(lookahead: float, adaptive: float, velocity: float) -> float:
    """Return how far ahead the carrot is, metres; a negative `lookahead` asks for the default.

    Raises:
        ValueError: It is zero.
    """
    if lookahead == 0.0:
        raise ValueError("lookahead distance cannot be 0")
    if lookahead > 0.0:
        return lookahead
    return max(velocity * 0.02 * (30.0 if adaptive > 0.0 else 40.0), 0.75)


def braked(velocity: float, remaining: float) -> float:
    """Return the speed (m/s) at which to fly with some metres to go.

    Before the end it falls to 1 m/s, by 3 m/s². (AirSim brakes later, and only from above 3 m/s,
    and overshoots.)
    """
    return min(velocity, math.sqrt(1.0 + 2.0 * 3.0 * max(remaining - CLOSE, 0.0)))


class Carrot:
    """Follows a vehicle's progress along a path, which never goes back.

    Args:
        path: Corners, metres; at least one. The first is where the vehicle starts.
        lookahead: Metres along the path from the vehicle's place to the carrot.

    Attributes:
        progress: Metres along the path up to the point next to the vehicle.
        length: Of the path, metres.
        is_last: Whether the carrot is at the end of the path.
    """

    def __init__(self, path: Sequence[Vector3], lookahead: float) -> None:
        corners = [path[0]]
        for point in path[1:-1]:
            if math.dist(point, corners[-1]) >= _SPACING:
                corners.append(point)
        if len(path) > 1:
            corners.append(path[-1])
        self._corners = corners
        steps = itertools.starmap(math.dist, itertools.pairwise(corners))
        self._along = [0.0, *itertools.accumulate(steps)]
        self._lookahead = lookahead
        self.length = self._along[-1]
        self.progress = 0.0
        self.is_last = False

    def advance(self, position: Vector3) -> Vector3:
        """Take a vehicle's position (m), and return where the carrot is."""
        self._advance_progress(position)
        ahead = min(self.progress + self._lookahead, self.length)
        # Round a sharp corner, it may be where the vehicle is already: then it runs on, up to 5 m.
        for _ in range(50):
            if ahead >= self.length or math.dist(self._at(ahead), position) >= CLOSE:
                break
            ahead = min(ahead + 0.1, self.length)
        self.is_last = ahead >= self.length
        return self._at(ahead)

    def _advance_progress(self, position: Vector3) -> None:
        along, corners = self._along, self._corners
        first = max(bisect.bisect_right(along, self.progress) - 1, 0)
        farthest = self.progress + 2.0 * max(self._lookahead, CLOSE)
        nearest = math.inf
        found = self.progress
        for index in range(first, min(first + _WINDOW, len(corners) - 1)):
            start, length = along[index], along[index + 1] - along[index]
            if start > farthest:
                break
            if length <= 0.0:
                continue
            a, b = corners[index], corners[index + 1]
            inner = sum((q - p) * (r - p) for p, q, r in zip(a, b, position, strict=True))
            place = start + min(max(inner / length, 0.0), length)
            place = min(max(place, self.progress), farthest)
            apart = math.dist(self._at(place), position)
            if apart < nearest:
                nearest, found = apart, place
        self.progress = found

    def _at(self, place: float) -> Vector3:
        """Return the point at some metres along the path."""
        along, corners = self._along, self._corners
        index = min(bisect.bisect_right(along, place), len(along) - 1) - 1
        if index < 0 or along[index + 1] <= along[index]:
            return corners[-1]
        share = min((place - along[index]) / (along[index + 1] - along[index]), 1.0)
        x, y, z = (p + share * (q - p) for p, q in zip(*corners[index : index + 2], strict=True))
        return x, y, z
