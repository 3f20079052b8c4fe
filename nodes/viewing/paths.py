"""Paths in short pieces, so that each pose is sent to a viewer once."""

from __future__ import annotations

from math import dist

from events import Vector3

SPAN = 250_000_000
"""Nanoseconds that a piece covers."""

GAP = 500_000_000
"""Nanoseconds without a pose that break a path."""

GRAIN = 0.01
"""Metres: poses nearer than this to the last are left out."""


class PathPieces:
    """Cuts one path, as it grows, into pieces."""

    def __init__(self) -> None:
        self._points: list[Vector3] = []
        self._first = 0
        self._last = 0

    def add(self, stamp: int, position: Vector3) -> list[Vector3] | None:
        """Add a pose (ns, metres); return a piece when one is complete.

        Each piece begins where the one before ended, unless there was a gap between them.
        """
        piece = None
        if self._points and not 0 <= stamp - self._last <= GAP:
            piece = self.rest()
            self._points.clear()
        self._last = stamp
        if not self._points:
            self._points.append(position)
            self._first = stamp
        elif dist(self._points[-1], position) >= GRAIN:
            self._points.append(position)
            if stamp - self._first >= SPAN:
                piece = self.rest()
                self._points = [position]
                self._first = stamp
        return piece

    def rest(self) -> list[Vector3] | None:
        """Return the points that are in no complete piece, if they make a line."""
        return list(self._points) if len(self._points) > 1 else None
