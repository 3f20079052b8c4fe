"""One frame for all of ORB-SLAM3's maps, whose own frames it rotates, scales and merges.

ORB-SLAM3's world is that of its present map: when it has been lost for long it starts another one
at identity, when it recognizes a place it merges the two, and when the IMU's scale and gravity
become known it turns the world upright. What stays is the map's first key frame, whose present
pose is read whenever the world may have changed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from events.poses import pose_matrix

Floats = npt.NDArray[np.float64]


class KeyFrame(NamedTuple):
    """A key frame of the present map.

    Attributes:
        stamp: Seconds, to a microsecond; tells key frames apart.
        pose: The camera in ORB-SLAM3's world now, shape (4, 4).
    """

    stamp: float
    pose: Floats


class Anchor:
    """Takes poses from ORB-SLAM3's worlds to the frame of the very first key frame.

    A map that starts after tracking was lost is put at the last known pose of the camera, since
    nothing better is known: so the motion in between is missing, until the maps are merged.
    """

    def __init__(self) -> None:
        self._first: dict[float, Floats] = {}  # first key frames of all maps, in our frame
        self._from_world = np.eye(4)
        self._last = np.eye(4)
        self._doubted = False
        self._map = 0.0  # stamp of its first key frame

    @property
    def maps(self) -> int:
        """How many maps there have been."""
        return len(self._first)

    @property
    def map(self) -> int:
        """Number of the map that poses are placed by; 0 before there is one."""
        return list(self._first).index(self._map) if self._first else 0

    def world_may_have_changed(self, first: KeyFrame, pose: Floats) -> None:
        """Take note of the first key frame of the map in which the camera is now.

        Args:
            first: That key frame.
            pose: The camera now in the same world, shape (4, 4).
        """
        known = first.stamp in self._first
        if not known:
            begin = np.linalg.inv(pose) @ first.pose  # first key frame in the camera now
            self._first[first.stamp] = self._last @ begin if self._first else np.eye(4)
        from_world = self._first[first.stamp] @ np.linalg.inv(first.pose)
        # The world may turn between the moment of the pose and that of the key frame's: then the
        # old one fits this pose, and the new one the next.
        old_fits = self._jump(self._from_world, pose) < self._jump(from_world, pose)
        self._doubted = known and old_fits and not self._doubted
        if not self._doubted:
            self._from_world, self._map = from_world, first.stamp

    def _jump(self, from_world: Floats, pose: Floats) -> float:
        """Return how far a pose would be from the last one."""
        return float(np.linalg.norm((from_world @ pose)[:3, 3] - self._last[:3, 3]))

    def first(self, stamp: float) -> tuple[int, Floats] | None:
        """Return a map's number and its first key frame in our frame, by that one's stamp."""
        known = enumerate(self._first.items())
        return next(((n, pose) for n, (at, pose) in known if abs(at - stamp) < 1e-4), None)

    def place(self, pose: Floats) -> Floats:
        """Return a pose in the frame of the very first key frame; remembered as the last one."""
        self._last = self._from_world @ pose
        return self._last

    @property
    def last(self) -> Floats:
        """The last pose that was known; identity before the first."""
        return self._last


def first_key_frame(trajectory: Path) -> KeyFrame | None:
    """Read the first pose of a trajectory in TUM's format; None if it is empty."""
    with trajectory.open(encoding="ascii") as lines:
        words = lines.readline().split()
    if len(words) != 8:
        return None
    stamp, x, y, z, qx, qy, qz, qw = map(float, words)
    return KeyFrame(stamp, pose_matrix((x, y, z), (qw, qx, qy, qz)))
