"""The frames on ``/tf`` and ``/tf_static``, and the paths of vehicles and estimates.

REP 105: ``odom`` is the vehicle's start, so ``map → odom`` is fixed. Poses in, transforms in ROS's
names and axes out. A ``nav_msgs/msg/Path`` is kept as bytes to send again.
"""

from __future__ import annotations

import struct
from math import dist
from typing import Any, NamedTuple

import numpy as np

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    ImuAnnouncement,
    Odometry,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    SensorAnnouncement,
    TransformStamped,
    Vector3,
    VehicleAnnouncement,
)
from events.frames import OPTICAL_TO_FLU, Axes, convert_rotation, convert_vector, inverse, multiply
from events.geometry import Pose, relative
from nodes.ros2.messages.topics import FrameNames, PublishingConfig, ros_name
from nodes.ros2.messages.typestore import Time, TypeStore
from runtime.time.clock import SECOND

_LINK_IN_OPTICAL = inverse(OPTICAL_TO_FLU)


class Transform(NamedTuple):
    """A frame in its parent, already in ROS's names and axes."""

    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion


class Transforms:
    """The tree of frames of all vehicles and cameras.

    Args:
        vehicle: The only one shown; if empty, all are.
        body: ``truth``, or the source of the estimates that place its vehicle instead.
    """

    def __init__(self, names: FrameNames, vehicle: str, body: str) -> None:
        self._names = names
        self._only = vehicle
        self._body = body
        self._starts: dict[str, Pose] = {}  # by vehicle
        self._fixed: dict[tuple[str, str], tuple[str, Pose]] = {}  # to parent, pose; by vehicle
        self._mounted: dict[str, tuple[str, str, Pose] | None] = {}
        """Source, parent and pose of a mounted camera, by optical frame; `None` for a free camera.
        """
        self._free: dict[str, str] = {}  # optical frame of each free camera, by source
        self._bodies: set[str] = set()  # sources, and frames, of self-moving bodies

    def announced(self, announcement: Announcement) -> None:
        """Add where a vehicle starts, or where a camera is mounted."""
        if isinstance(announcement, VehicleAnnouncement):
            source = announcement.source
            if self._only in {"", source} and source not in self._starts:
                self._names.vehicles.add(source)
                self._starts[source] = announcement.position, announcement.orientation
                self._fixed[source, "odom"] = "map", self._starts[source]
        elif isinstance(announcement, CameraAnnouncement):
            self._names.add(announcement)
            optical, parent = announcement.frame_id, announcement.parent_frame_id
            if parent == "map":
                self._free[announcement.source] = optical
                self._mounted[optical] = None
            else:
                mounting = announcement.position, announcement.orientation
                self._mounted[optical] = announcement.source, parent, mounting
        elif isinstance(announcement, SensorAnnouncement | ImuAnnouncement):
            if announcement.frame_id != announcement.parent_frame_id:
                mounting = announcement.position, announcement.orientation
                key = announcement.source, announcement.frame_id
                self._fixed[key] = announcement.parent_frame_id, mounting
        elif isinstance(announcement, BodyAnnouncement):
            self._bodies.add(announcement.source)

    def add_static(self, event: TransformStamped) -> bool:
        """Add a node's transform, if fixed; return whether the frame is new."""
        vehicle, child = self._names.vehicles.of(event.source), event.child_frame_id
        if not event.static or self._names.camera(child) or self._is_fixed(vehicle, child):
            return False
        self._fixed[vehicle, child] = event.frame_id, (event.translation, event.rotation)
        return True

    def static(self) -> list[Transform]:
        """Return all fixed transforms."""
        links = [
            self._turned(parent, child, pose, source)
            for (source, child), (parent, pose) in self._fixed.items()
        ]
        for optical, mounted in self._mounted.items():
            if mounted is not None:
                source, parent, pose = mounted
                links.append(self._link(parent, optical, pose, source))
            frames = self._names.camera(optical)
            assert frames is not None
            links.append(Transform(frames.link, frames.optical, (0.0, 0.0, 0.0), OPTICAL_TO_FLU))
        return links

    def of(
        self, event: Odometry | PoseEstimate | PoseStamped | TransformStamped
    ) -> list[Transform]:
        """Return the transforms of the moving frames in an event."""
        match event:
            case Odometry():
                return self.odometry(event)
            case PoseEstimate():
                return self.estimate(event)
            case PoseStamped():
                return self.pose(event)
            case TransformStamped():
                return self.moving(event)

    def odometry(self, event: Odometry) -> list[Transform]:
        """Return the transform of a true pose: a vehicle's body, or a body with its own frame."""
        known = not self._starts or event.source in self._starts
        if not known and (self._only or event.child_frame_id == "base_link"):
            return []
        if self._body != "truth" and self._is_of_body(event.source):
            return []
        return self._place(event)

    def estimate(self, event: PoseEstimate) -> list[Transform]:
        """Return the body's transform by an estimate."""
        return self._place(event) if event.source == self._body else []

    def pose(self, event: PoseStamped) -> list[Transform]:
        """Return the transform of a free camera, or of a self-moving body."""
        if event.source in self._bodies:
            axes = self._names.axes(event.frame_id)
            rotation = convert_rotation(axes, "body", event.orientation)
            place = convert_vector(axes, event.position)
            return [Transform(event.frame_id, ros_name(event.source), place, rotation)]
        frame_id = self._free.get(event.source)
        if frame_id is None:
            return []
        pose = event.position, event.orientation
        return [self._link(event.frame_id, frame_id, pose, event.source)]

    def moving(self, event: TransformStamped) -> list[Transform]:
        """Return a node's moving transform, unless the frame is placed otherwise."""
        child = event.child_frame_id
        fixed = self._is_fixed(self._names.vehicles.of(event.source), child)
        if fixed or self._names.camera(child) or child == "base_link":
            return []
        pose = event.translation, event.rotation
        return [self._turned(event.frame_id, child, pose, event.source)]

    def _is_fixed(self, vehicle: str, child: str) -> bool:
        return any(
            frame == child and self._names.vehicles.of(source) == vehicle
            for source, frame in self._fixed
        )

    def _is_of_body(self, source: str) -> bool:
        return self._names.vehicles.of(source) == self._names.vehicles.of(self._body)

    def _place(self, event: Odometry | PoseEstimate) -> list[Transform]:
        parent, child = event.frame_id, event.child_frame_id
        vehicle = self._names.vehicles.of(event.source)
        if self._is_fixed(vehicle, child) or self._names.camera(child):
            return []
        pose, start = (event.position, event.orientation), self._starts.get(vehicle)
        if parent == "map" and start is not None:
            parent, pose = "odom", relative(start, pose)
        return [self._turned(parent, child, pose, event.source)]

    def _turned(self, parent: str, child: str, pose: Pose, source: str) -> Transform:
        parent_axes, child_axes = self._names.axes(parent), self._names.axes(child)
        rotation = convert_rotation(parent_axes, child_axes, pose[1])
        names = self._names.name(parent, source), self._names.name(child, source)
        return Transform(*names, convert_vector(parent_axes, pose[0]), rotation)

    def _link(self, parent: str, optical: str, pose: Pose, source: str) -> Transform:
        """Return a camera's body in its parent, from its optical frame's pose."""
        axes: Axes = self._names.axes(parent)
        frames = self._names.camera(optical)
        assert frames is not None
        rotation = multiply(convert_rotation(axes, "optical", pose[1]), _LINK_IN_OPTICAL)
        name = self._names.name(parent, source)
        return Transform(name, frames.link, convert_vector(axes, pose[0]), rotation)


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
        self._count = 0
        self._last: Vector3 = (0.0, 0.0, 0.0)
        self._count_at = _CDR + _aligned(12 + len(name) + 1, 4)

    def far(self, position: Vector3) -> bool:
        """Return whether `add` is due: the pose is a step away from the last one."""
        return not self._count or dist(position, self._last) >= self.step

    def add(self, time: Time, position: Vector3, orientation: Quaternion) -> None:
        """Add a pose, in ROS's axes, at a time (s, ns)."""
        if self._count == len(self._rows) - 1:  # the last is for the newest pose
            half = self._rows[: self._count : 2].copy()
            self._rows[: len(half)] = half
            self._count, self.step = len(half), 2.0 * self.step
        self._set_row(self._count, time, position, orientation)
        self._count, self._last = self._count + 1, position

    def message(self, time: Time, position: Vector3, orientation: Quaternion) -> bytearray:
        """Return the path up to a pose, kept or not; arguments are as of `add`."""
        self._set_row(self._count, time, position, orientation)
        count = self._count + (self._count == 0 or dist(position, self._last) > 0.0)
        data = self._first(time)
        _COUNT.pack_into(data, self._count_at, count)
        data += self._rows[1:count].tobytes()
        return data

    def _set_row(self, index: int, time: Time, position: Vector3, orientation: Quaternion) -> None:
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
