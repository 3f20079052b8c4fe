"""The paths that are drawn, kept for those who begin to look late. Pure Python."""

from __future__ import annotations

from collections import deque

from events import Vector3
from nodes.viewing.paths import Path

Colour = tuple[float, float, float]
"""Red, green, blue, 0 to 1."""

TRUTH, PLAN = (0.31, 0.86, 0.47), (0.6, 0.6, 0.65)
ESTIMATES = [(1.0, 0.63, 0.1), (0.35, 0.67, 1.0), (0.9, 0.43, 0.9), (0.98, 0.9, 0.31)]

_KEPT = 4000
"""Pieces of a path; older ones are forgotten. A piece covers a quarter of a second."""


class Trail:
    """A path, as far as it has been flown.

    Args:
        name: Of the entity.
        frame_id: In which its points are.
        colour: Of the line.
        thickness: Metres.
    """

    def __init__(self, name: str, frame_id: str, colour: Colour, thickness: float) -> None:
        self.name = name
        self.frame_id = frame_id
        self.colour = colour
        self.thickness = thickness
        self._path = Path()
        self._pieces: deque[list[Vector3]] = deque(maxlen=_KEPT)
        self._number = 0

    def add(self, stamp: int, position: Vector3) -> tuple[str, list[Vector3]] | None:
        """Take in a pose (ns, metres); return a new piece and its name, if there is one."""
        piece = self._path.add(stamp, position)
        if piece is None:
            return None
        self._pieces.append(piece)
        self._number += 1
        return f"{self.name}/{self._number - 1}", piece

    def pieces(self) -> list[tuple[str, list[Vector3]]]:
        """Return all pieces there are, with their names."""
        pieces = list(self._pieces)
        first = self._number - len(pieces)
        return [(f"{self.name}/{first + i}", piece) for i, piece in enumerate(pieces)]
