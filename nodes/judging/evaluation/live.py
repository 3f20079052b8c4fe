"""Errors of an estimator while a run goes on."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from events import PoseEstimate
from events.poses import Pose, pose_matrix, pose_tuples
from events.rotations import angle_between


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
            matrix = pose_matrix(position, orientation)
            if self._origin is None:
                self._origin = pose_matrix(*truth) @ np.linalg.inv(matrix)
            position, orientation = pose_tuples(self._origin @ matrix)
        distance = math.dist(truth[0], position)
        self.count += 1
        self.sum_of_squares += distance * distance
        return distance, angle_between(truth[1], orientation)

    @property
    def mean_square(self) -> float:
        """Mean square of the position errors so far, square metres."""
        return self.sum_of_squares / self.count if self.count else 0.0
