"""What ``/tf`` and ``/tf_static`` say: map → odom → base_link → camera_link → camera_optical_frame.

REP 105: ``odom`` is where the vehicle started, so ``map → odom`` is fixed, and estimates that are
in ``odom`` stand where they should. Poses in, transforms in ROS's names and axes out; no messages.
"""

from __future__ import annotations

from events import (
    Announcement,
    CameraAnnouncement,
    Odometry,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    TransformStamped,
    Vector3,
    VehicleAnnouncement,
)
from nodes.ros2_bridge.frames import (
    OPTICAL_IN_LINK,
    Axes,
    conjugate,
    multiply,
    relative,
    turn_rotation,
    turn_vector,
)
from nodes.ros2_bridge.messages import Transform
from nodes.ros2_bridge.plan import FrameNames

Pose = tuple[Vector3, Quaternion]

_LINK_IN_OPTICAL = conjugate(OPTICAL_IN_LINK)


class Transforms:
    """The tree of frames of one vehicle and all cameras.

    Args:
        names: What ROS calls our frames.
        vehicle: Whose ``base_link`` it is; if empty, the first announced one's.
        body: ``truth``, or the source of the estimates that place it.
    """

    def __init__(self, names: FrameNames, vehicle: str, body: str) -> None:
        self._names = names
        self._vehicle = vehicle
        self._body = body
        self._start: Pose | None = None
        self._static: dict[str, Transform] = {}
        """By child."""
        self._free: dict[str, str] = {}
        """Sources of cameras that nothing carries, to their optical frame."""

    def announced(self, announcement: Announcement) -> None:
        """Take in where a vehicle stands, or where a camera is mounted."""
        if isinstance(announcement, VehicleAnnouncement):
            if self._vehicle in {"", announcement.source} and self._start is None:
                self._vehicle = announcement.source
                self._start = announcement.position, announcement.orientation
                self._fix("map", "odom", self._start)
        elif isinstance(announcement, CameraAnnouncement):
            frames = self._names.add(announcement)
            if announcement.parent_frame_id == "map":
                self._free[announcement.source] = announcement.frame_id
            else:
                mounting = announcement.position, announcement.orientation
                camera = self._link(announcement.parent_frame_id, announcement.frame_id, mounting)
                self._static[camera.child] = camera
            self._static[frames.optical] = Transform(
                frames.link, frames.optical, (0.0, 0.0, 0.0), OPTICAL_IN_LINK
            )

    def add_static(self, event: TransformStamped) -> bool:
        """Take in a fixed transform that a node sent; tell whether it is news."""
        if self._names.camera(event.child_frame_id) or event.child_frame_id in self._static:
            return False
        self._fix(event.frame_id, event.child_frame_id, (event.translation, event.rotation))
        return True

    def static(self) -> list[Transform]:
        """Return all fixed transforms."""
        return list(self._static.values())

    def odometry(self, event: Odometry) -> list[Transform]:
        """Return where a vehicle's true pose puts its body."""
        if self._body != "truth" or (self._vehicle and event.source != self._vehicle):
            return []
        return self._place(event.frame_id, event.child_frame_id, event.position, event.orientation)

    def estimate(self, event: PoseEstimate) -> list[Transform]:
        """Return where an estimate puts the body."""
        if event.source != self._body:
            return []
        return self._place(event.frame_id, event.child_frame_id, event.position, event.orientation)

    def pose(self, event: PoseStamped) -> list[Transform]:
        """Return where a free camera is."""
        frame_id = self._free.get(event.source)
        if frame_id is None:
            return []
        return [self._link(event.frame_id, frame_id, (event.position, event.orientation))]

    def moving(self, event: TransformStamped) -> list[Transform]:
        """Return a moving transform that a node sent."""
        if self._names.camera(event.child_frame_id) or event.child_frame_id == "base_link":
            return []
        pose = event.translation, event.rotation
        return [self._turned(event.frame_id, event.child_frame_id, pose)]

    def _place(
        self, parent: str, child: str, position: Vector3, orientation: Quaternion
    ) -> list[Transform]:
        if child in self._static or self._names.camera(child):
            return []
        pose = position, orientation
        if parent == "map" and self._start is not None:
            parent, pose = "odom", relative(self._start, pose)
        return [self._turned(parent, child, pose)]

    def _fix(self, parent: str, child: str, pose: Pose) -> None:
        self._static[self._names.name(child)] = self._turned(parent, child, pose)

    def _turned(self, parent: str, child: str, pose: Pose) -> Transform:
        to, of = self._names.axes(parent), self._names.axes(child)
        rotation = turn_rotation(to, of, pose[1])
        names = self._names.name(parent), self._names.name(child)
        return Transform(*names, turn_vector(to, pose[0]), rotation)

    def _link(self, parent: str, optical: str, pose: Pose) -> Transform:
        """Return a camera's body in its parent, from its optical frame's pose."""
        axes: Axes = self._names.axes(parent)
        frames = self._names.camera(optical)
        assert frames is not None
        rotation = multiply(turn_rotation(axes, "optical", pose[1]), _LINK_IN_OPTICAL)
        return Transform(
            self._names.name(parent), frames.link, turn_vector(axes, pose[0]), rotation
        )
