"""Where frames were in each other, at any time: transforms gathered into a tree, and looked up.

Pure: a node feeds it from its handlers. The frames themselves are defined in `events.geometry`.

    tree.add_odometry(odometry)          # map → base_link
    tree.add(mounting)                   # base_link → drone/camera_optical, for all times
    tree.lookup("map", "drone/camera_optical", image.stamp) @ point
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from events import Odometry, TransformStamped
from events.geometry import Pose, pose_matrix
from nodes.trajectory import RecentPoses

Floats = npt.NDArray[np.float64]

HISTORY = 10.0
"""Seconds."""


class TransformError(LookupError):
    """A transform is not known. The message says what is.

    TransformError
    ├── UnknownFrameError        no transform has named a frame
    ├── UnconnectedFramesError   no chain of transforms leads from one frame to the other
    └── UnknownTimeError         a transform of the chain is not known at that time, or no more
    """


class UnknownFrameError(TransformError):
    """No transform has named the frame."""


class UnconnectedFramesError(TransformError):
    """No chain of transforms leads from one frame to the other."""


class UnknownTimeError(TransformError):
    """A transform is known for other times only."""


class TransformTree:
    """Frames, each but the roots in one parent.

    Args:
        history: Seconds for which a moving transform is remembered, back from the newest.

    Raises:
        ValueError: `history` is negative.
    """

    def __init__(self, history: float = HISTORY) -> None:
        if not history >= 0.0:
            raise ValueError(f"history: expected 0 s or more, found {history}")
        self._history = round(history * 1e9) if math.isfinite(history) else None
        self._edges: dict[str, _Edge] = {}
        """By child."""
        self._frames: dict[str, None] = {}

    def add(self, transform: TransformStamped) -> None:
        """Take in a transform. Those of one edge may come in any order.

        Raises:
            ValueError: It is no transform; or no tree would be left, because the child has
                another parent or is an ancestor of this one; or it is static where those before
                it were not, or the other way round.
        """
        self._add(
            transform.frame_id,
            transform.child_frame_id,
            transform.stamp,
            (transform.translation, transform.rotation),
            transform.static,
        )

    def add_odometry(self, event: Odometry) -> None:
        """Take in a body's pose, as the transform from the body to its parent.

        Raises:
            ValueError: As for `add`.
        """
        pose = event.position, event.orientation
        self._add(event.frame_id, event.child_frame_id, event.stamp, pose)

    def lookup(self, target: str, source: str, stamp: int) -> Floats:
        """Return the transform that takes coordinates in `source` to coordinates in `target`.

        That is the pose of `source` in `target`. Between two stamps of a moving transform the
        position is interpolated linearly and the orientation by slerp (K. Shoemake, "Animating
        rotation with quaternion curves", 1985); beyond them nothing is guessed.

        Args:
            stamp: Nanoseconds.

        Returns:
            float64, shape (4, 4).

        Raises:
            UnknownFrameError: No transform has named one of the frames.
            UnconnectedFramesError: They are in different trees.
            UnknownTimeError: `stamp` lies outside what is remembered of a transform between them.
        """
        up, down = self._line(source), self._line(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            raise UnconnectedFramesError(
                f"{target} from {source}: expected a chain of transforms between them, found "
                f"{source} under {up[-1]} and {target} under {down[-1]}"
            )
        there, here = (self._chain(line, shared, stamp) for line in (down, up))
        return np.asarray(np.linalg.inv(there) @ here)

    def span(self, child: str) -> tuple[int, int] | None:
        """Return the first and last stamp (ns) known of a frame in its parent; None: all times.

        Raises:
            UnknownFrameError: No transform has named the frame, or it has no parent.
        """
        if child not in self._edges:
            raise UnknownFrameError(f"expected a frame with a parent, found {child!r}")
        edge = self._edges[child]
        return None if edge.static else edge.poses.span()

    def _line(self, frame: str) -> list[str]:
        """Return a frame and its ancestors."""
        if frame not in self._frames:
            known = ", ".join(self._frames) or "none"
            raise UnknownFrameError(f"expected one of the known frames ({known}), found {frame!r}")
        line = [frame]
        while (edge := self._edges.get(line[-1])) is not None:
            line.append(edge.parent)
        return line

    def _chain(self, line: list[str], end: str, stamp: int) -> Floats:
        """Return the first frame of a line in one of its ancestors."""
        matrix = np.eye(4)
        for child in line[: line.index(end)]:
            matrix = self._edges[child].at(stamp) @ matrix
        return matrix

    def _add(self, parent: str, child: str, stamp: int, pose: Pose, static: bool = False) -> None:
        where = f"{parent} → {child}"
        edge = self._edges.get(child)
        if edge is None:
            ancestors = self._line(parent) if parent in self._frames else [parent]
            if child in ancestors:
                raise ValueError(f"{where}: expected a tree, but {child} is above {parent}")
            edge = self._edges[child] = _Edge(parent, child, static, self._history)
            self._frames |= {parent: None, child: None}
        elif edge.parent != parent:
            raise ValueError(
                f"{where}: expected one parent for each frame, but {child} is in {edge.parent}"
            )
        elif edge.static != static:
            kinds = ("moving", "static")
            raise ValueError(f"{where}: expected a {kinds[edge.static]} transform as before")
        edge.poses.add(stamp, *pose)


class _Edge:
    """What is known of one frame in its parent."""

    __slots__ = ("child", "parent", "poses", "static")

    def __init__(self, parent: str, child: str, static: bool, history: int | None) -> None:
        self.parent = parent
        self.child = child
        self.static = static
        self.poses = RecentPoses(0 if static else history)

    def at(self, stamp: int) -> Floats:
        """Return the child's pose in the parent, shape (4, 4)."""
        first, last = self.poses.span() or (0, 0)
        pose = self.poses.at(last if self.static else stamp)
        if pose is None:
            raise UnknownTimeError(
                f"{self.parent} → {self.child}: expected a stamp from {first / 1e9:.9f} s to "
                f"{last / 1e9:.9f} s, found {stamp / 1e9:.9f} s"
            )
        return pose_matrix(*pose)
