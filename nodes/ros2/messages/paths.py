"""Path of a vehicle, or of an estimate, as ``nav_msgs/msg/Path``, kept as bytes to send again."""

from __future__ import annotations

import struct
from math import dist
from typing import Any

import numpy as np

from events import Odometry, PoseEstimate, Quaternion, Vector3
from events.frames import convert_rotation, convert_vector
from nodes.ros2.messages.topics import FrameNames, PublishingConfig
from nodes.ros2.messages.typestore import Time, TypeStore
from runtime.time.schedule import SECOND

_COUNT = struct.Struct("<I")
_CDR = 4  # bytes before a message, excluded from alignment
_POSE = 56  # seven float64: position, and the quaternion's x, y, z, w


class Paths:
    """The paths of all vehicles and estimates."""

    def __init__(self, store: TypeStore, names: FrameNames, config: PublishingConfig) -> None:
        self._store, self._names, self._config = store, names, config
        self._paths: dict[str, tuple[PathMessage, int]] = {}
        """With the next sending (ns), by source."""

    def message(self, event: Odometry | PoseEstimate, time: Time) -> bytearray | None:
        """Add a pose to its source's path, at a message time (s, ns); return the path if due."""
        config, frame = self._config, self._names.name(event.frame_id, event.source)
        path, due = self._paths.get(event.source, (None, event.stamp))
        if path is None or path.frame != frame:
            path = PathMessage(self._store, frame, config.path_step, config.path_length)
            self._paths[event.source] = (path, due)
        axes = self._names.axes(event.frame_id)
        position = convert_vector(axes, event.position)
        far = path.far(position)
        if not far and event.stamp < due:
            return None
        rotation = convert_rotation(axes, self._names.axes(event.child_frame_id), event.orientation)
        if far:
            path.add(time, position, rotation)
        if event.stamp < due:
            return None
        self._paths[event.source] = (path, event.stamp + round(SECOND / config.path_rate))
        return path.message(time, position, rotation)


class PathMessage:
    """Message of a path: poses of a body in a frame.

    Args:
        frame: The poses' parent, as ROS calls it.
        step: Metres between kept poses.
        length: Poses of a message at most; beyond, every other is left out and the step doubled.
    """

    def __init__(self, store: TypeStore, frame: str, step: float, length: int) -> None:
        self.frame, self.step, self._store = frame, step, store
        name = frame.encode()
        head = 12 + len(name) + 1  # stamp, length of the name, the name, a zero
        self._row = np.dtype(
            {
                "names": ["sec", "nanosec", "size", "name", "pose"],
                "formats": ["<i4", "<u4", "<u4", f"S{len(name) + 1}", ("<f8", 7)],
                "offsets": [0, 4, 8, 12, _aligned(head, 8)],
                "itemsize": _aligned(head, 8) + _POSE,
            }
        )
        self._rows = np.zeros(length, self._row)
        self._rows["size"], self._rows["name"] = len(name) + 1, name
        self._kept = 0
        self._last: Vector3 = (0.0, 0.0, 0.0)
        self._count_at = _CDR + _aligned(12 + len(name) + 1, 4)

    def far(self, position: Vector3) -> bool:
        """Tell whether a pose here would be kept."""
        return not self._kept or dist(position, self._last) >= self.step

    def add(self, time: Time, position: Vector3, orientation: Quaternion) -> None:
        """Keep a pose, in ROS's axes, at a time (s, ns)."""
        if self._kept == len(self._rows) - 1:  # the last is for the newest pose
            half = self._rows[: self._kept : 2].copy()
            self._rows[: len(half)] = half
            self._kept, self.step = len(half), 2.0 * self.step
        self._put(self._kept, time, position, orientation)
        self._kept, self._last = self._kept + 1, position

    def message(self, time: Time, position: Vector3, orientation: Quaternion) -> bytearray:
        """Return the path up to a pose, kept or not; arguments are as of `add`."""
        self._put(self._kept, time, position, orientation)
        count = self._kept + (self._kept == 0 or dist(position, self._last) > 0.0)
        data = self._first(time)
        _COUNT.pack_into(data, self._count_at, count)
        data += self._rows[1:count].tobytes()
        return data

    def _put(self, index: int, time: Time, position: Vector3, orientation: Quaternion) -> None:
        row, (w, x, y, z) = self._rows[index], orientation
        row["sec"], row["nanosec"] = time
        row["pose"] = (*position, x, y, z, w)

    def _first(self, time: Time) -> bytearray:
        """Return a path of the first pose: all later poses are aligned alike."""
        make, row = self._store.message, self._rows[0]
        x, y, z, qx, qy, qz, qw = row["pose"].tolist()
        pose: Any = make("geometry_msgs/msg/Pose")(
            position=make("geometry_msgs/msg/Point")(x=x, y=y, z=z),
            orientation=make("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )
        stamp = int(row["sec"]), int(row["nanosec"])
        header = self._store.header(stamp, self.frame)
        first = make("geometry_msgs/msg/PoseStamped")(header=header, pose=pose)
        path = make("nav_msgs/msg/Path")(header=self._store.header(time, self.frame), poses=[first])
        return self._store.serialize(path)


def _aligned(offset: int, size: int) -> int:
    return -(-offset // size) * size
