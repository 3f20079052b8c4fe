"""What one estimator sent during a run, and what is plainly wrong with it."""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np
import numpy.typing as npt

from events import PoseEstimate, TrackingEvent, TrackingLost, TrajectoryEstimate
from nodes.judging.evaluation.coverage import Interval
from nodes.trajectory import PoseRows, Trajectory

Floats = npt.NDArray[np.float64]

_AHEAD = 1_000_000
"""Nanoseconds by which a stamp may be later than its arrival: clocks are that close."""


class Said:
    """Rows of numbers that came with some of the poses, by their stamps, which rise.

    Args:
        width: Numbers of a row.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps, self._numbers = array("q"), array("d")

    def add(self, stamp: int, numbers: tuple[float, ...]) -> None:
        """Note what came with a pose."""
        self._stamps.append(stamp)
        self._numbers.extend(numbers)

    def __len__(self) -> int:
        return len(self._stamps)

    def at(self, stamps: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.bool_], Floats]:
        """Tell which stamps have a row, shape (n,), and return these, shape (m, width)."""
        mine = np.array(self._stamps, np.int64)
        rows = np.array(self._numbers, np.float64).reshape(-1, self._width)
        return np.isin(stamps, mine), rows[np.isin(mine, stamps)]


class EstimatorRecord:
    """Everything that came from one estimator.

    Its trajectory is made of the poses in the frame of its first pose, with stamps that
    rise. All others are counted, and are no poses of the flight:

    Args:
        scale_free: Whether its unit of length is its own.
        reads: Kinds of data that it computes with; see `events.EstimatorAnnouncement`.

    Attributes:
        rows: The poses of its trajectory.
        repeated: Poses whose stamp was not later than the one before: sent twice, or backwards.
        future: Poses, and losses, of a time that had not come when they arrived.
        bodies: How many poses are of which body (`child_frame_id`).
        elsewhere: Poses in another frame than the first one.
        restarts: How often it changed to another frame: each time it has lost where it is.
        velocities: Those that poses came with: 3 numbers.
        covariances: Likewise: 36 numbers, row by row.
        final: Its trajectory after loop closures, the last one that it sent; `None` if it sent
            none, or an empty one.
        final_frame_id: Frame of that.
    """

    def __init__(
        self, scale_free: bool = False, method: str = "", reads: tuple[str, ...] = ()
    ) -> None:
        self.scale_free = scale_free
        self.method = method
        self.reads = reads
        self.frame_id = ""
        self.rows = PoseRows()
        self.repeated = 0
        self.future = 0
        self.elsewhere = 0
        self.restarts = 0
        self.bodies: Counter[str] = Counter()
        self.velocities = Said(3)
        self.covariances = Said(36)
        self.final: Trajectory | None = None
        self.final_frame_id = ""
        self._last_stamp: int | None = None
        self._last_frame = ""
        self._arrivals = array("q")
        self._tracking: list[tuple[int, bool]] = []

    @classmethod
    def of(cls, trajectory: Trajectory) -> EstimatorRecord:
        """Return the record of a trajectory of which nobody knows when its poses came."""
        record = cls()
        for pose in trajectory.poses():
            record.rows.add(*pose)
        return record

    def add(self, event: PoseEstimate, now: int | None) -> bool:
        """Note an estimate and when it came (ns), if known; tell if it is of the trajectory."""
        if now is not None and event.stamp > now + _AHEAD:
            self.future += 1
            return False
        if self._last_stamp is not None and event.stamp <= self._last_stamp:
            self.repeated += 1
            return False
        self._last_stamp = event.stamp
        self.frame_id = self.frame_id or event.frame_id
        self.restarts += event.frame_id not in {self.frame_id, self._last_frame}
        self._last_frame = event.frame_id
        if event.frame_id != self.frame_id:
            self.elsewhere += 1
            return False
        self.rows.add(event.stamp, event.position, event.orientation)
        self.bodies[event.child_frame_id] += 1
        if now is not None:
            self._arrivals.append(now)
        if event.velocity is not None:
            self.velocities.add(event.stamp, event.velocity)
        if event.covariance:
            self.covariances.add(event.stamp, event.covariance)
        return True

    def add_final(self, event: TrajectoryEstimate) -> None:
        """Note its trajectory as it sees it now."""
        poses = event.stamps, event.positions, event.orientations
        self.final = Trajectory(*poses) if len(event.stamps) else None
        self.final_frame_id = event.frame_id

    def note(self, event: TrackingEvent, now: int) -> None:
        """Note that tracking was lost or regained; of a time to come, it counts from now (ns)."""
        self.future += event.stamp > now + _AHEAD
        self._tracking.append((min(event.stamp, now + _AHEAD), isinstance(event, TrackingLost)))

    def __len__(self) -> int:
        return len(self.rows)

    def arrivals(self) -> npt.NDArray[np.int64]:
        """Return when each pose of the trajectory came (ns), shape (n,); (0,) if not known."""
        return np.array(self._arrivals, np.int64)

    def reported_lost(self, end: int) -> list[Interval]:
        """Return when it was lost by its own tracking events.

        Args:
            end: Of the run (ns); it is lost until then if it does not report that it has regained.
        """
        found = []
        since: int | None = None
        for stamp, lost in self._tracking:
            if lost:
                since = stamp if since is None else since
            elif since is not None:
                found.append(Interval(since, stamp))
                since = None
        if since is not None:
            found.append(Interval(since, end))
        return found
