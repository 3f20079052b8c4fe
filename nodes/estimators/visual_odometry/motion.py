"""The motion of a camera from image to image, by which the next pose is expected."""

from __future__ import annotations

import math

import numpy as np

from nodes.estimators.odometry.images import Floats
from nodes.estimators.odometry.pose import motion_between, moved

_FADES = 0.5
"""Seconds without a measurement in which the expected velocity falls to 1/e."""


class Motion:
    """A velocity in the camera's own frame: constant, and fading where nothing is measured."""

    def __init__(self) -> None:
        self._velocity = np.zeros(6)  # metres and radians per second
        self._last: tuple[int, Floats] | None = None
        self._steady: tuple[int, Floats, Floats] | None = None

    def expected(self, stamp: int) -> Floats:
        """Return the pose at a time (ns), world to camera, shape (4, 4)."""
        if self._last is None:
            return np.eye(4)
        before, pose = self._last
        return moved(pose, self._velocity * (stamp - before) * 1e-9)

    def measured(self, stamp: int, pose: Floats) -> None:
        """Note a pose that was measured, world to camera, shape (4, 4)."""
        if self._last is not None and stamp > self._last[0]:
            before, last = self._last
            self._velocity = motion_between(last, pose) / ((stamp - before) * 1e-9)
        self._last = stamp, pose
        self._steady = stamp, pose, self._velocity

    def steady(self, stamp: int) -> Floats:
        """Return the pose at a time if the last measured velocity has not changed since."""
        if self._steady is None:
            return self.expected(stamp)
        before, pose, velocity = self._steady
        return moved(pose, velocity * (stamp - before) * 1e-9)

    def carried(self, stamp: int) -> Floats:
        """Return the pose at a time without a measurement, from which on the motion fades."""
        pose, before = self.expected(stamp), stamp if self._last is None else self._last[0]
        self._velocity = self._velocity * math.exp((before - stamp) * 1e-9 / _FADES)
        self._last = stamp, pose
        return pose

    def placed(self, stamp: int, pose: Floats) -> None:
        """Note a pose that was found again: how the camera moves is as unknown as before."""
        self._last = stamp, pose
