"""The poses of the last seconds, for nodes that look them up while a run goes on."""

from __future__ import annotations

from bisect import bisect_left

from events import Quaternion, Vector3
from events.poses import Pose
from events.rotations import slerp

HISTORY = 10_000_000_000
"""Nanoseconds for which poses are kept, if nothing else is asked for."""


class RecentPoses:
    """Poses of one frame in another, by time.

    Args:
        history: Nanoseconds for which poses are kept, back from the newest; `None` keeps all.
    """

    def __init__(self, history: int | None = HISTORY) -> None:
        self._history = history
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int, position: Vector3, orientation: Quaternion) -> None:
        """Take in a pose (ns, metres, w x y z), in any order; one of the same stamp is replaced."""
        stamps, poses = self._stamps, self._poses
        place = bisect_left(stamps, stamp)
        if place < len(stamps) and stamps[place] == stamp:
            poses[place] = position, orientation
            return
        stamps.insert(place, stamp)
        poses.insert(place, (position, orientation))
        if self._history is not None:
            old = bisect_left(stamps, stamps[-1] - self._history)
            del stamps[:old], poses[:old]

    def span(self) -> tuple[int, int] | None:
        """Return the first and the last stamp (ns) that are kept; `None` if there is none."""
        return (self._stamps[0], self._stamps[-1]) if self._stamps else None

    def at(self, stamp: int) -> Pose | None:
        """Return the pose at a time (ns): positions linear, orientations by slerp.

        A stamp that is kept gives its very pose. Before the first and after the last stamp nothing
        is guessed, and the result is `None`.
        """
        stamps, poses = self._stamps, self._poses
        after = bisect_left(stamps, stamp)
        if after == len(stamps):
            return None
        if stamps[after] == stamp:
            return poses[after]
        if after == 0:
            return None
        (p, q), (r, s) = poses[after - 1 : after + 1]
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        x, y, z = (a + share * (b - a) for a, b in zip(p, r, strict=True))
        return (x, y, z), slerp(q, s, share)
