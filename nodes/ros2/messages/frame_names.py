"""What ROS calls the frames of a run (REP 103 and REP 105), and how their axes lie."""

from __future__ import annotations

import msgspec

from events import CameraAnnouncement
from events.frames import Axes, axes_of
from nodes.ros2.messages.topics import ros_name
from nodes.vehicles import Vehicles


class CameraFrames(msgspec.Struct, frozen=True):
    """A camera's two frames in ROS (REP 103): ``camera_link`` and ``camera_optical_frame``."""

    link: str
    optical: str


class FrameNames:
    """Our frames' names and axes, and what ROS calls them.

    Of one vehicle alone, frames have the names of REP 105 (``odom``, ``base_link``). Once there is
    a second, the vehicle's name stands before those of each: ``drone/odom``, ``drone/base_link``.
    Whose frame is meant follows from the source: ``drone/camera`` is of ``drone``.
    """

    def __init__(self) -> None:
        self._cameras: dict[str, tuple[str, str]] = {}
        """Optical frame to the camera's source and its own name."""
        self.own: set[str] = set()
        """Frames whose names say already whose they are: ROS calls them the same."""
        self.vehicles = Vehicles()
        """Whose frames are distinguished."""

    def add(self, camera: CameraAnnouncement) -> CameraFrames:
        """Add a camera: its frames have its own name, or its vehicle's too if that is taken."""
        self.vehicles.announced(camera)
        if camera.frame_id not in self._cameras:
            name = ros_name(camera.source.rpartition("/")[2])
            if any(known == name for _, known in self._cameras.values()):
                name = ros_name(camera.source).replace("/", "_")
            self._cameras[camera.frame_id] = (camera.source, name)
        found = self.camera(camera.frame_id)
        assert found is not None
        return found

    def camera(self, frame_id: str) -> CameraFrames | None:
        """Return the frames of the camera with this optical frame, if there is one."""
        known = self._cameras.get(frame_id)
        if known is None:
            return None
        source, name = known
        prefix = ""
        if len(self.vehicles.names) > 1 and (vehicle := self.vehicles.carrier(source)):
            prefix, name = f"{ros_name(vehicle)}/", ros_name(source.rpartition("/")[2])
        return CameraFrames(f"{prefix}{name}_link", f"{prefix}{name}_optical_frame")

    def name(self, frame_id: str, source: str = "") -> str:
        """Return what ROS calls a frame that a source names."""
        if frame_id == "map" or frame_id in self.own:
            return frame_id
        camera = self.camera(frame_id)
        if camera is not None:
            return camera.optical
        vehicle = self.vehicles.of(source)
        own = frame_id.removeprefix(f"{vehicle}/")  # ``drone/lidar``, which names it already
        return f"{ros_name(vehicle)}/{own}" if len(self.vehicles.names) > 1 else own

    def axes(self, frame_id: str) -> Axes:
        """Return how a frame's axes lie."""
        return "optical" if frame_id in self._cameras else axes_of(frame_id)
