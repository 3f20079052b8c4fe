"""Record of an estimator's events, and the coverage of a flight by its poses.

Coverage is measured on the stamps of all images: silence before the first pose and after the last
one counts. Arrival plays no part: late estimates show in `latency`.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import PoseEstimate, TrackingEvent, TrackingLost, TrajectoryEstimate, Vector3
from nodes.trajectory import PoseRows, Trajectory
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

_AHEAD = 1_000_000  # tolerated difference of clocks (stamp and earlier arrival), ns


class Interval(NamedTuple):
    """A stretch of time, nanoseconds."""

    start: int
    end: int


class Coverage(msgspec.Struct, frozen=True):
    """Coverage of a flight by an estimator's poses."""

    flight: Interval  # from the first image to the last
    frames: int  # number of images, missing ones of an early end included
    answered: int  # images with a pose of their own, within half an image's period
    lost: list[Interval]  # disjoint intervals without a pose, in order

    @property
    def percent(self) -> float:
        """Share of the flight's time not lost, percent."""
        length = self.flight.end - self.flight.start
        if not length:
            return 100.0 if self.answered else 0.0
        return max(100.0 * (1.0 - seconds(self.lost) * SECOND / length), 0.0)

    @property
    def frames_percent(self) -> float:
        """Share of the images with a pose, percent."""
        return 100.0 * self.answered / self.frames


def cover(
    frames: Stamps,  # stamps of the images, strictly rising, shape (n,), n ≥ 1
    poses: Stamps,  # stamps of the poses, strictly rising, shape (m,)
    gap: int,  # silence that counts (ns)
    announced: Sequence[Interval] = (),  # intervals reported as lost by the estimator, in any order
    planned: int | None = None,
) -> Coverage:
    """Return the coverage of a flight by poses.

    Lost is no pose for longer than `gap` (ns) although there were images, or by the estimator's own
    word; a camera slower than `gap` causes no loss.

    Args:
        planned: Planned end of the flight (ns), if it was ended before: images at their usual rate
            until then are without a pose.
    """
    first, last = int(frames[0]), int(frames[-1])
    has_pose = answered(frames, poses)
    inside = poses[(poses >= first) & (poses <= last)]
    starts, ends = np.append(first, inside), np.append(inside, last)
    unanswered = np.append(0, np.cumsum(~has_pose))  # in the first k images
    missing = (
        unanswered[np.searchsorted(frames, ends, side="right")]
        - unanswered[np.searchsorted(frames, starts, side="left")]
    )
    silent = np.flatnonzero((ends - starts > gap) & (missing > 0))
    clipped = [Interval(max(s, first), min(e, last)) for s, e in announced]
    lost = [Interval(int(starts[k]), int(ends[k])) for k in silent]
    lost += [interval for interval in clipped if interval.end > interval.start]
    count = len(frames)
    if planned is not None and planned > last > first:
        count += round((planned - last) * (count - 1) / (last - first))
        lost.append(Interval(last, planned))
        last = planned
    return Coverage(Interval(first, last), count, int(has_pose.sum()), union(lost))


def answered(frames: Stamps, poses: Stamps) -> npt.NDArray[np.bool_]:
    """Return a mask, shape (n,), of images with a pose of their own within half the image period.

    A pose answers at most one image, the nearest (the earlier of two equally near).
    """
    has_pose = np.zeros(len(frames), np.bool_)
    rows, distance = nearest(frames, poses)
    period = int(np.median(np.diff(frames))) if len(frames) > 1 else 0
    has_pose[rows[2 * distance <= period]] = True
    return has_pose


def nearest(frames: Stamps, poses: Stamps) -> tuple[Stamps, Stamps]:
    """Return the row of the image nearest to each pose, and their distance (ns): shapes (m,)."""
    after = np.clip(np.searchsorted(frames, poses), 0, len(frames) - 1)
    before = np.clip(after - 1, 0, None)
    rows = np.where(poses - frames[before] <= frames[after] - poses, before, after)
    return rows, abs(poses - frames[rows])


SAME = 1_000_000  # difference of stamps that are the same, ns: those of files are rounded


def choose_camera(
    cameras: Mapping[str, Stamps], poses: Stamps, read: Collection[str] = ()
) -> str | None:
    """Return the camera that an estimator reads, of those with images.

    It is one of those in `read`, if that is known, or else of all: that with images at the stamps
    of most poses; of several the one of which the greatest share of the images is answered, such as
    the slower one of two that are triggered together; then the quickest.

    Args:
        cameras: Stamps of the images (ns), strictly rising, by source.
        read: Sources that it is known to read.

    Returns:
        `None` without images.
    """
    seen = [source for source, stamps in cameras.items() if len(stamps)]
    known = [source for source in seen if source in read or source.removesuffix("/grey") in read]

    def fit(source: str) -> tuple[int, float, int]:
        stamps = cameras[source]
        shared = nearest(stamps, poses)[1] <= SAME
        return int(shared.sum()), float(answered(stamps, poses).mean()), len(stamps)

    return max(known or seen, key=fit, default=None)


def choose_frames(cameras: Mapping[str, Stamps], poses: Stamps) -> Stamps | None:
    """Return the stamps of the images of an estimator's camera; see `choose_camera`."""
    camera = choose_camera(cameras, poses)
    return None if camera is None else cameras[camera]


def union(intervals: Sequence[Interval]) -> list[Interval]:
    """Return the union of intervals, disjoint and in order."""
    merged: list[Interval] = []
    for interval in sorted(intervals):
        if merged and interval.start <= merged[-1].end:
            merged[-1] = Interval(merged[-1].start, max(merged[-1].end, interval.end))
        else:
            merged.append(interval)
    return merged


def seconds(intervals: Sequence[Interval]) -> float:
    """Return how long intervals are together."""
    return sum(interval.end - interval.start for interval in intervals) / SECOND


class SampledRows:
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


class MapRecord:
    """An estimator's poses in one frame, with strictly rising stamps: those of one map."""

    def __init__(self, frame_id: str = "") -> None:
        self.frame_id = frame_id
        self.rows = PoseRows()
        self.arrivals = array("q")  # of its poses (ns), if known
        self.bodies: Counter[str] = Counter()  # number of poses by body (`child_frame_id`)
        self.velocities = SampledRows(3)  # velocities of the poses that carry one: 3 numbers
        self.covariances = SampledRows(36)  # likewise: 36 numbers, row by row

    def add(self, event: PoseEstimate, now: int | None) -> None:
        """Add an estimate and its arrival (ns, if known)."""
        self.rows.add(event.stamp, event.position, event.orientation)
        self.bodies[event.child_frame_id] += 1
        if now is not None:
            self.arrivals.append(now)
        if event.velocity is not None:
            self.velocities.add(event.stamp, event.velocity)
        if event.covariance:
            self.covariances.add(event.stamp, event.covariance)

    def __len__(self) -> int:
        return len(self.rows)


class EstimatorRecord:
    """Record of an estimator: its poses by frame, and losses of tracking.

    Poses in another frame are those of another map, whose place, and often unit of length, are not
    known in the first. Judged is the map with most poses, the earliest of equal ones; the poses of
    all others are only counted.
    """

    def __init__(
        self,
        scale_free: bool = False,  # whether its unit of length is arbitrary
        method: str = "",
        reads: tuple[str, ...] = (),  # see `events.EstimatorAnnouncement`
    ) -> None:
        self.scale_free, self.method, self.reads = scale_free, method, reads
        # The point of the body (m) whose poses are judged: the camera, if its poses have been moved
        # to the body in a unit that is not the metre.
        self.lever: Vector3 = (0.0, 0.0, 0.0)
        self.longest = MapRecord()
        self.maps: dict[str, MapRecord] = {}  # by frame, in the order of their first poses
        self.repeated = 0  # poses with a stamp not later than the last
        self.future = 0  # poses and tracking events stamped later than their arrival
        self.restarts = 0  # number of changes to another frame, one after each loss of tracking
        # The last trajectory after loop closures; `None` for none, or an empty one.
        self.final: Trajectory | None = None
        self.final_frame_id = ""  # frame of `final`
        self._last_stamp: int | None = None
        self._last_frame = ""
        self._tracking: list[tuple[int, bool]] = []

    @classmethod
    def of(cls, trajectory: Trajectory, frame_id: str = "") -> EstimatorRecord:
        """Return the record of a trajectory without arrival times."""
        record = cls()
        record.longest = record.maps[frame_id] = MapRecord(frame_id)
        for pose in trajectory.poses():
            record.longest.rows.add(*pose)
        return record

    def add(self, event: PoseEstimate, now: int | None) -> bool:
        """Add an estimate and its arrival (ns, if known); return whether the longest map grew."""
        if now is not None and event.stamp > now + _AHEAD:
            self.future += 1
            return False
        if self._last_stamp is not None and event.stamp <= self._last_stamp:
            self.repeated += 1
            return False
        self._last_stamp = event.stamp
        frame = event.frame_id
        if frame not in self.maps:
            self.maps[frame] = MapRecord(frame)
        self.restarts += frame not in {next(iter(self.maps)), self._last_frame}
        self._last_frame = frame
        grown = self.maps[frame]
        grown.add(event, now)
        if len(grown) > len(self.longest):
            self.longest = grown
        return grown is self.longest

    def add_final(self, event: TrajectoryEstimate) -> None:
        """Store the estimator's latest trajectory after loop closures."""
        poses = event.stamps, event.positions, event.orientations
        self.final = Trajectory(*poses) if len(event.stamps) else None
        self.final_frame_id = event.frame_id

    def add_tracking(self, event: TrackingEvent, now: int) -> None:
        """Record a tracking event; a stamp in the future is counted, and clipped to `now` (ns)."""
        self.future += event.stamp > now + _AHEAD
        self._tracking.append((min(event.stamp, now + _AHEAD), isinstance(event, TrackingLost)))

    def stamps(self) -> Stamps:
        """Return the stamps of the longest map's poses (ns), strictly rising, shape (n,)."""
        rows = self.longest.rows
        return rows.trajectory().stamps if len(rows) else np.empty(0, np.int64)

    def arrivals(self) -> npt.NDArray[np.int64]:
        """Return when each pose of the longest map came (ns), shape (n,); (0,) if not known."""
        return np.array(self.longest.arrivals, np.int64)

    def elsewhere(self) -> str:
        """Return, in words, what is not judged since it is in other frames; empty if nothing is."""
        others = sum(map(len, self.maps.values())) - len(self.longest)
        if not others:
            return ""
        return (
            f"judged are the {len(self.longest)} poses in {self.longest.frame_id!r}, most of those "
            f"in {len(self.maps)} frames; {others} in others are left out"
        )

    def reported_lost(self, end: int) -> list[Interval]:
        """Return the lost intervals reported by the estimator, up to the run's end (ns)."""
        intervals = []
        since: int | None = None
        for stamp, lost in self._tracking:
            if lost:
                since = stamp if since is None else since
            elif since is not None:
                intervals.append(Interval(since, stamp))
                since = None
        if since is not None:
            intervals.append(Interval(since, end))
        return intervals
