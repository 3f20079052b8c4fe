"""Common parts of viewers: colours, shapes, paths in pieces, choice of images and plan."""

from __future__ import annotations

from collections import deque
from math import dist
from typing import NamedTuple

import numpy as np

from events import Event, PlannedPose, PoseEstimate, PositionSetpoint, Quaternion, Vector3
from events.geometry import pose_matrix, pose_tuples
from nodes.trajectory import RecentPoses
from runtime.time.clock import SECOND

Colour = tuple[int, int, int]  # red, green, blue, 0 to 255
TRUTH: Colour = (80, 220, 120)
_TRUTHS: list[Colour] = [TRUTH, (60, 200, 190), (170, 215, 70), (40, 160, 110)]
PLAN: Colour = (140, 140, 150)
WIND: Colour = (120, 200, 255)
INLIER: Colour = (90, 240, 120)
OUTLIER: Colour = (240, 80, 70)

_ESTIMATES: list[Colour] = [
    (255, 160, 20),
    (90, 170, 255),
    (230, 110, 230),
    (250, 230, 80),
    (120, 230, 230),
]


class Box(NamedTuple):
    """A box in the frame of a body, along its axes: centre and lengths of its sides in metres."""

    centre: Vector3
    size: Vector3
    colour: Colour


VEHICLE = [
    Box((0.0, 0.0, 0.0), (0.2, 0.12, 0.07), (200, 200, 210)),
    Box((0.09, 0.0, 0.0), (0.06, 0.06, 0.04), (230, 80, 70)),
    *(
        Box((x, y, -0.03), (0.18, 0.18, 0.012), (90, 95, 110))
        for x in (-0.14, 0.14)
        for y in (-0.14, 0.14)
    ),
]  # a body with a nose and four rotors


_SIZES: dict[str, Vector3] = {"person": (0.5, 0.5, 1.8), "car": (4.2, 1.8, 1.5)}


def moving_body(kind: str) -> Box:
    """Return a box of a self-moving body's usual size: nothing else is known of its shape."""
    return Box((0.0, 0.0, 0.0), _SIZES.get(kind, (0.5, 0.5, 0.5)), (235, 150, 60))


def estimate_colour(index: int) -> Colour:
    """Return the colour of the n-th estimator, from 0."""
    return _ESTIMATES[index % len(_ESTIMATES)]


def truth_colour(index: int) -> Colour:
    """Return the colour of the n-th vehicle's true path, from 0."""
    return _TRUTHS[index % len(_TRUTHS)]


def describe(event: Event) -> str:
    """Return a tracking or vehicle event in words."""
    more = getattr(event, "reason", "") or getattr(event, "other", "")
    return type(event).__name__ + (f" ({more})" if more else "")


SPAN = 250_000_000  # duration of a piece, nanoseconds
GAP = 500_000_000  # time without a pose to break a path, nanoseconds
GRAIN = 0.01  # metres: poses nearer than this to the last are left out


class PathPieces:
    """Divider of a growing path into pieces."""

    def __init__(self) -> None:
        self._points: list[Vector3] = []
        self._first = 0
        self._last = 0

    def add(self, stamp: int, position: Vector3) -> list[Vector3] | None:
        """Add a pose (ns, metres); return a complete piece, joined to the last but for gaps."""
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
        """Return the points of the incomplete piece, if enough for a line."""
        return list(self._points) if len(self._points) > 1 else None


def estimate_frame(
    event: PoseEstimate, truth: RecentPoses | None
) -> tuple[Vector3, Quaternion] | None:
    """Return an estimate's frame in ``map``: its first pose laid on the true one, or `None`."""
    true_pose = None if truth is None else truth.at(event.stamp)
    if true_pose is None:
        return None
    estimated = pose_matrix(event.position, event.orientation)
    return pose_tuples(pose_matrix(*true_pose) @ np.linalg.inv(estimated))


_KEPT = 4000  # pieces of a path; older ones are forgotten. A piece covers a quarter of a second.


class Trail:
    """Path flown so far; its thickness is in metres."""

    def __init__(self, name: str, frame_id: str, colour: Colour, thickness: float) -> None:
        self.name, self.frame_id, self.colour, self.thickness = name, frame_id, colour, thickness
        self._path = PathPieces()
        self._pieces: deque[list[Vector3]] = deque(maxlen=_KEPT)
        self._number = 0

    def add(self, stamp: int, position: Vector3) -> tuple[str, list[Vector3]] | None:
        """Add a pose (ns, metres); return a new piece and its name, if complete."""
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


REMEMBERED = 64  # images of a camera whose features may still come


class ImageSelection:
    """Selection of images by their stamps: all of an exposure are shown, or none."""

    def __init__(
        self,
        rate: float,  # images a second at most; 0: none
    ) -> None:
        self._rate = rate
        self._last: dict[tuple[str, str], int] = {}
        self._selected: dict[str, deque[int]] = {}

    def select(self, kind: str, source: str, frame_id: str, stamp: int) -> bool:
        """Tell whether an image, by stamp (ns), is the first of its kind and source in a period."""
        if not self._rate:
            return False
        period = int(stamp * self._rate // SECOND)
        if self._last.get((kind, source)) == period:
            return False
        self._last[kind, source] = period
        self._selected.setdefault(frame_id, deque(maxlen=REMEMBERED)).append(stamp)
        return True

    def selected(self, frame_id: str, stamp: int) -> bool:
        """Tell whether an image of this camera and exposure is shown."""
        return stamp in self._selected.get(frame_id, ())


class PlanSelection:
    """Selection of a vehicle's plan to draw: planned poses, or set-points if there are none."""

    def __init__(self) -> None:
        self._kinds: dict[str, type[PlannedPose | PositionSetpoint]] = {}

    def select(self, event: PlannedPose | PositionSetpoint) -> bool:
        """Tell whether an event is part of the plan."""
        if self._kinds.get(event.vehicle) is not PlannedPose:
            self._kinds[event.vehicle] = type(event)
        return isinstance(event, self._kinds[event.vehicle])
