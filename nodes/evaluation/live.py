"""Errors while a run goes on: the truth's last seconds, and an estimate held against it."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
import numpy.typing as npt

from events import PoseEstimate, Quaternion, Vector3
from events.poses import Pose, pose_matrix, pose_tuples
from events.rotations import angle_between
from nodes.evaluation.metrics import position_error

SECOND = 1_000_000_000
HISTORY = 10 * SECOND


class RecentTruth:
    """The true poses of the last seconds."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque()
        self._poses: deque[Pose] = deque()

    def add(self, stamp: int, position: Vector3, orientation: Quaternion) -> None:
        """Note a pose (ns, metres, w x y z); what is too old goes."""
        self._stamps.append(stamp)
        self._poses.append((position, orientation))
        while self._stamps[0] < stamp - HISTORY:
            self._stamps.popleft()
            self._poses.popleft()

    def at(self, stamp: int) -> Pose | None:
        """Return the pose at a time, between two by the share of time; `None` if not known.

        Between poses milliseconds apart a straight line between quaternions is as good as an arc.
        """
        stamps = self._stamps
        after = bisect_left(stamps, stamp)
        if after == len(stamps):
            return None
        (p1, q1) = self._poses[after]
        if stamps[after] == stamp:
            return p1, q1
        if after == 0:
            return None
        (p0, q0) = self._poses[after - 1]
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        x, y, z = (a + share * (b - a) for a, b in zip(p0, p1, strict=True))
        sign = 1.0 if sum(a * b for a, b in zip(q0, q1, strict=True)) >= 0 else -1.0
        w, i, j, k = (a + share * (sign * b - a) for a, b in zip(q0, q1, strict=True))
        length = (w * w + i * i + j * j + k * k) ** 0.5
        return (x, y, z), (w / length, i / length, j / length, k / length)


class LiveErrors:
    """Errors of one estimator so far. An estimate in ``odom`` is laid on the truth at its first."""

    def __init__(self) -> None:
        self.count = 0
        self.sum_of_squares = 0.0
        self._origin: npt.NDArray[np.float64] | None = None

    def of(self, event: PoseEstimate, truth: Pose) -> tuple[float, float]:
        """Return the errors of an estimate: metres, radians."""
        position, orientation = event.position, event.orientation
        if event.frame_id != "map":
            said = pose_matrix(position, orientation)
            if self._origin is None:
                self._origin = pose_matrix(*truth) @ np.linalg.inv(said)
            position, orientation = pose_tuples(self._origin @ said)
        distance = position_error(truth[0], position)
        self.count += 1
        self.sum_of_squares += distance * distance
        return distance, angle_between(truth[1], orientation)

    @property
    def mean_square(self) -> float:
        """Mean square of the position errors so far, square metres."""
        return self.sum_of_squares / self.count if self.count else 0.0
