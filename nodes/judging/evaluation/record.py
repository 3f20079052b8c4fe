"""Record of an estimator's events, with counts of its invalid poses."""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np
import numpy.typing as npt

from events import PoseEstimate, TrackingEvent, TrackingLost, TrajectoryEstimate
from nodes.judging.evaluation.coverage import Interval
from nodes.trajectory import PoseRows, Trajectory

Floats = npt.NDArray[np.float64]

_AHEAD = 1_000_000  # tolerated difference of clocks (stamp and earlier arrival), ns


class Said:
    """Rows of numbers of some of the poses (velocity, covariance), by rising stamp."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps, self._numbers = array("q"), array("d")

    def add(self, stamp: int, numbers: tuple[float, ...]) -> None:
        """Add the row of a pose."""
        self._stamps.append(stamp)
        self._numbers.extend(numbers)

    def __len__(self) -> int:
        return len(self._stamps)

    def at(self, stamps: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.bool_], Floats]:
        """Return a mask of the stamps with a row, shape (n,), and their rows, (m, width)."""
        mine = np.array(self._stamps, np.int64)
        rows = np.array(self._numbers, np.float64).reshape(-1, self._width)
        return np.isin(stamps, mine), rows[np.isin(mine, stamps)]


class EstimatorRecord:
    """Events of an estimator, sorted into a trajectory and counts.

    The trajectory has the poses in the first one's frame, with strictly rising stamps; others are
    only counted.
    """

    def __init__(
        self,
        scale_free: bool = False,  # whether its unit of length is arbitrary
        method: str = "",
        reads: tuple[str, ...] = (),  # see `events.EstimatorAnnouncement`
    ) -> None:
        self.scale_free, self.method, self.reads = scale_free, method, reads
        self.frame_id = ""
        self.rows = PoseRows()  # poses of the trajectory
        self.repeated = 0  # poses with a stamp not later than the last
        self.future = 0  # poses and tracking events stamped later than their arrival
        self.elsewhere = 0  # poses in another frame than the first one
        self.restarts = 0  # number of changes to another frame, one after each loss of tracking
        self.bodies: Counter[str] = Counter()  # number of poses by body (`child_frame_id`)
        self.velocities = Said(3)  # velocities of the poses that carry one: 3 numbers
        self.covariances = Said(36)  # likewise: 36 numbers, row by row
        # The last trajectory after loop closures; `None` for none, or an empty one.
        self.final: Trajectory | None = None
        self.final_frame_id = ""  # frame of `final`
        self._last_stamp: int | None = None
        self._last_frame = ""
        self._arrivals = array("q")
        self._tracking: list[tuple[int, bool]] = []

    @classmethod
    def of(cls, trajectory: Trajectory) -> EstimatorRecord:
        """Return the record of a trajectory without arrival times."""
        record = cls()
        for pose in trajectory.poses():
            record.rows.add(*pose)
        return record

    def add(self, event: PoseEstimate, now: int | None) -> bool:
        """Add an estimate and its arrival (ns, if known); return whether the trajectory grew."""
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
        """Store the estimator's latest trajectory after loop closures."""
        poses = event.stamps, event.positions, event.orientations
        self.final = Trajectory(*poses) if len(event.stamps) else None
        self.final_frame_id = event.frame_id

    def note(self, event: TrackingEvent, now: int) -> None:
        """Record a tracking event; a stamp in the future is counted, and clipped to `now` (ns)."""
        self.future += event.stamp > now + _AHEAD
        self._tracking.append((min(event.stamp, now + _AHEAD), isinstance(event, TrackingLost)))

    def __len__(self) -> int:
        return len(self.rows)

    def arrivals(self) -> npt.NDArray[np.int64]:
        """Return when each pose of the trajectory came (ns), shape (n,); (0,) if not known."""
        return np.array(self._arrivals, np.int64)

    def reported_lost(self, end: int) -> list[Interval]:
        """Return the lost intervals reported by the estimator, up to the run's end (ns)."""
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
