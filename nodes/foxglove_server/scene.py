"""The paths that are drawn, kept for viewers that connect late."""

from __future__ import annotations

from collections import deque

from events import Vector3
from nodes.viewing.appearance import Colour
from nodes.viewing.paths import PathPieces

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
        self._path = PathPieces()
        self._pieces: deque[list[Vector3]] = deque(maxlen=_KEPT)
        self._number = 0

    def add(self, stamp: int, position: Vector3) -> tuple[str, list[Vector3]] | None:
        """Add a pose (ns, metres); return a new piece and its name, if one is complete."""
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
