"""Coverage of a flight by poses, and the intervals without a pose.

Measured on the stamps of all images: silence before the first pose and after the last one counts.
Arrival plays no part: late estimates show in `latency`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from runtime.time.schedule import SECOND

Stamps = npt.NDArray[np.int64]


class Interval(NamedTuple):
    """A stretch of time, nanoseconds."""

    start: int
    end: int


class Coverage(msgspec.Struct, frozen=True):
    """Coverage of a flight by an estimator's poses."""

    flight: Interval  # from the first image to the last
    frames: int  # number of images, missing ones of an early end included
    answered: int  # images with a pose within half an image's period
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
    word; a camera slower than `gap` makes nobody lost.

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
    lost += [each for each in clipped if each.end > each.start]
    count = len(frames)
    if planned is not None and planned > last > first:
        count += round((planned - last) * (count - 1) / (last - first))
        lost.append(Interval(last, planned))
        last = planned
    return Coverage(Interval(first, last), count, int(has_pose.sum()), union(lost))


def answered(frames: Stamps, poses: Stamps) -> npt.NDArray[np.bool_]:
    """Return a mask, shape (n,), of images with a pose within half the image period."""
    if not len(poses):
        return np.zeros(len(frames), np.bool_)
    period = int(np.median(np.diff(frames))) if len(frames) > 1 else 0
    after = np.clip(np.searchsorted(poses, frames), 0, len(poses) - 1)
    before = np.clip(after - 1, 0, None)
    distance = np.minimum(abs(poses[after] - frames), abs(poses[before] - frames))
    return np.asarray(2 * distance <= period)


def choose_frames(cameras: Mapping[str, Stamps], poses: Stamps) -> Stamps | None:
    """Return the stamps of the first camera that shares most poses; `None` without images."""
    there = (stamps for stamps in cameras.values() if len(stamps))
    return max(there, key=lambda stamps: int(np.isin(poses, stamps).sum()), default=None)


def union(intervals: Sequence[Interval]) -> list[Interval]:
    """Return the union of intervals, disjoint and in order."""
    found: list[Interval] = []
    for each in sorted(intervals):
        if found and each.start <= found[-1].end:
            found[-1] = Interval(found[-1].start, max(found[-1].end, each.end))
        else:
            found.append(each)
    return found


def seconds(intervals: Sequence[Interval]) -> float:
    """Return how long intervals are together."""
    return sum(each.end - each.start for each in intervals) / SECOND
