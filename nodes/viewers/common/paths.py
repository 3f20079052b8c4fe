"""Paths in short pieces, so that each pose is sent to a viewer once, and where estimates lie."""

from __future__ import annotations

from collections import deque
from math import dist

import numpy as np

from events import PoseEstimate, Quaternion, Vector3
from events.poses import pose_matrix, pose_tuples
from nodes.trajectory import RecentPoses
from nodes.viewers.common.appearance import Colour

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


def estimate_frame(
    event: PoseEstimate, truth: RecentPoses | None
) -> tuple[Vector3, Quaternion] | None:
    """Return the pose of an estimate's frame in ``map``, from its first estimate.

    The first pose lies where the body truly was, as evaluation aligns it; `None` if that is not
    known.
    """
    found = None if truth is None else truth.at(event.stamp)
    if found is None:
        return None
    estimated = pose_matrix(event.position, event.orientation)
    return pose_tuples(pose_matrix(*found) @ np.linalg.inv(estimated))


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
