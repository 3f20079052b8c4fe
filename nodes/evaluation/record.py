"""What was said of one estimator's poses while a run went on, and the intervals it was lost in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from events import PoseEstimate, TrackingEvent, TrackingLost
from nodes.trajectory import PoseRows, Trajectory

SECOND = 1_000_000_000


class Interval(NamedTuple):
    """A stretch of time, nanoseconds."""

    start: int
    end: int


class EstimatorRecord:
    """Everything that came from one estimator.

    Args:
        scale_free: Whether its unit of length is its own.
        method: What it is.
    """

    def __init__(self, scale_free: bool = False, method: str = "") -> None:
        self.scale_free = scale_free
        self.method = method
        self.frame_id = ""
        self.child_frame_id = ""
        self.rows = PoseRows()
        self._arrivals: dict[int, int] = {}  # by stamp
        self._tracking: list[TrackingEvent] = []

    def add(self, event: PoseEstimate, now: int) -> None:
        """Note an estimate that has come at a time (ns)."""
        self.frame_id, self.child_frame_id = event.frame_id, event.child_frame_id
        self.rows.add(event.stamp, event.position, event.orientation)
        self._arrivals[event.stamp] = now

    def note(self, event: TrackingEvent) -> None:
        """Note that tracking was lost or regained."""
        self._tracking.append(event)

    def __len__(self) -> int:
        return len(self.rows)

    def arrivals(self, estimate: Trajectory) -> npt.NDArray[np.int64]:
        """Return when each pose came (ns), shape (n,)."""
        return np.array([self._arrivals[stamp] for stamp in estimate.stamps.tolist()], np.int64)

    def lost(self, end: int, gap: int) -> list[Interval]:
        """Return when there were no poses: by its own word, or by its silence.

        Time before the first pose is not counted: a monocular estimator has to see motion first.

        Args:
            end: Of the run (ns).
            gap: Silence that counts (ns).
        """
        found = []
        since: int | None = None
        for event in self._tracking:
            if isinstance(event, TrackingLost):
                since = event.stamp if since is None else since
            elif since is not None:
                found.append(Interval(since, event.stamp))
                since = None
        if since is not None:
            found.append(Interval(since, end))
        stamps = sorted(self._arrivals)
        for before, after in zip(stamps, [*stamps[1:], end], strict=True):
            if after - before > gap:
                found.append(Interval(before, after))
        return union(found)


def union(intervals: list[Interval]) -> list[Interval]:
    """Return the same time as intervals that do not touch, in order."""
    found: list[Interval] = []
    for each in sorted(intervals):
        if found and each.start <= found[-1].end:
            found[-1] = Interval(found[-1].start, max(found[-1].end, each.end))
        else:
            found.append(each)
    return found


def seconds(intervals: list[Interval]) -> float:
    """Return how long intervals are together."""
    return sum(each.end - each.start for each in intervals) / SECOND
