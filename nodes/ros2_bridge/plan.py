"""Which topics there will be, what they are called, and in which frames: from announcements.

Pure: nothing here knows Zenoh or CDR.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from events import (
    Announcement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    ImuAnnouncement,
    VehicleAnnouncement,
)
from nodes.ros2_bridge.frames import Axes, axes_of
from nodes.ros2_bridge.keys import Qos, ros_name, topic_name
from nodes.ros2_bridge.settings import Kind, Ros2BridgeConfig

What = Literal[
    "image",
    "mono",
    "info",
    "compressed",
    "depth",
    "depth_info",
    "compressed_depth",
    "segmentation",
    "cloud",
    "imu",
    "odometry",
    "pose",
    "estimate",
    "score",
    "range",
    "pressure",
    "magnetic",
    "fix",
    "lidar",
    "path",
    "tf",
    "tf_static",
    "clock",
]

NAMES: dict[What, tuple[str, str, Kind]] = {
    "image": ("{}/image_raw", "sensor_msgs/msg/Image", "images"),
    "mono": ("{}/image_mono", "sensor_msgs/msg/Image", "images"),
    "info": ("{}/camera_info", "sensor_msgs/msg/CameraInfo", "images"),
    "compressed": ("{}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", "images"),
    "depth": ("{}/depth/image_raw", "sensor_msgs/msg/Image", "depth"),
    "depth_info": ("{}/depth/camera_info", "sensor_msgs/msg/CameraInfo", "depth"),
    "compressed_depth": (
        "{}/depth/image_raw/compressedDepth",
        "sensor_msgs/msg/CompressedImage",
        "depth",
    ),
    "segmentation": ("{}/segmentation/image_raw", "sensor_msgs/msg/Image", "segmentation"),
    "cloud": ("{}/points", "sensor_msgs/msg/PointCloud2", "clouds"),
    "imu": ("{}/imu", "sensor_msgs/msg/Imu", "imu"),
    "odometry": ("{}/odom", "nav_msgs/msg/Odometry", "odometry"),
    "pose": ("{}/pose", "geometry_msgs/msg/PoseStamped", "poses"),
    "estimate": ("{}/pose", "geometry_msgs/msg/PoseStamped", "estimates"),
    "score": ("scores/{}", "std_msgs/msg/Float64", "scores"),
    "range": ("{}/range", "sensor_msgs/msg/Range", "ranges"),
    "pressure": ("{}/pressure", "sensor_msgs/msg/FluidPressure", "pressures"),
    "magnetic": ("{}/mag", "sensor_msgs/msg/MagneticField", "magnetic_fields"),
    "fix": ("{}/fix", "sensor_msgs/msg/NavSatFix", "fixes"),
    "lidar": ("{}/lidar", "sensor_msgs/msg/PointCloud2", "lidars"),
    "path": ("{}/path", "nav_msgs/msg/Path", "paths"),
    "tf": ("/tf", "tf2_msgs/msg/TFMessage", "tf"),
    "tf_static": ("/tf_static", "tf2_msgs/msg/TFMessage", "tf"),
    "clock": ("/clock", "rosgraph_msgs/msg/Clock", "clock"),
}

_QOS: dict[What, Qos] = {
    "tf": Qos(depth=100),
    "tf_static": Qos(depth=1, transient_local=True),
    "clock": Qos(depth=1, reliable=False),
    "path": Qos(depth=1),
}

_SENSORS: set[What] = {
    "image", "mono", "info", "compressed", "depth", "depth_info", "compressed_depth",
    "segmentation", "lidar", "imu", "range", "pressure", "magnetic", "fix"
}  # fmt: skip
"""With the quality of service of rclcpp's ``SensorDataQoS``."""


class Publication(msgspec.Struct, frozen=True, kw_only=True):
    """A topic to publish.

    Attributes:
        what: Kind of message.
        source: Of the events that become its messages.
        topic: Full name.
        type: Of its messages.
        qos: Quality of service.
    """

    what: What
    source: str
    topic: str
    type: str
    qos: Qos


def publication(what: What, source: str, config: Ros2BridgeConfig) -> Publication | None:
    """Return the topic for what a source says; `None` if it is not to be published."""
    pattern, type_, kind = NAMES[what]
    if kind not in config.publish or (what == "clock" and config.time == "wall"):
        return None
    name = pattern.format(ros_name(source))
    if what == "imu" and name.endswith("/imu/imu"):
        name = name.removesuffix("/imu")
    full = topic_name(config.namespace, name)
    given = config.topics.get(full, config.topics.get(name))
    if what == "estimate" and config.covariance:
        type_ = "geometry_msgs/msg/PoseWithCovarianceStamped"
    sensors = Qos(depth=5, reliable=config.sensor_qos == "reliable")
    return Publication(
        what=what,
        source=source,
        topic=full if given is None else topic_name(config.namespace, given),
        type=type_,
        qos=sensors if what in _SENSORS else _QOS.get(what, Qos()),
    )


def announced(announcement: Announcement, config: Ros2BridgeConfig) -> Iterator[Publication]:
    """Yield the topics for what a node announced."""
    whats: list[What] = []
    match announcement:
        case CameraAnnouncement(images=images):
            whats = [*camera_topics(images, config), "pose"]
        case ImuAnnouncement():
            whats = ["imu"]
        case VehicleAnnouncement():
            whats = ["odometry", "path"]
        case EstimatorAnnouncement():
            whats = ["estimate", "path"]
    for what in whats:
        if found := publication(what, announcement.source, config):
            yield found


def camera_topics(images: tuple[str, ...], config: Ros2BridgeConfig) -> Iterator[What]:
    """Yield the topics for the images that a camera gives."""
    if "rgb" in images or "grey" in images:
        yield "info"
        if config.raw:
            yield "image"
            if "rgb" in images and "grey" in images:
                yield "mono"
        if config.compressed:
            yield "compressed"
    if "depth" in images:
        yield "depth_info"
        if config.raw or not config.compressed_depth:
            yield "depth"
        if config.compressed_depth:
            yield "compressed_depth"
    if "segmentation" in images:
        yield "segmentation"


class CameraFrames(msgspec.Struct, frozen=True):
    """A camera's two frames in ROS (REP 103): ``camera_link`` and ``camera_optical_frame``."""

    link: str
    optical: str


class FrameNames:
    """Our frames' names and axes, and what ROS calls them.

    Of one vehicle alone, frames have the names of REP 105 (``odom``, ``base_link``). Once there is
    a second, the vehicle's name stands before those of each: ``drone/odom``, ``drone/base_link``.
    Whose frame is meant follows from who speaks: ``drone/camera`` is of ``drone``.
    """

    def __init__(self) -> None:
        self._cameras: dict[str, tuple[str, str]] = {}
        """Optical frame to the camera's source and its own name."""
        self._vehicles: list[str] = []

    def add_vehicle(self, source: str) -> None:
        """Take in a vehicle."""
        if source not in self._vehicles:
            self._vehicles.append(source)

    def add(self, camera: CameraAnnouncement) -> CameraFrames:
        """Take in a camera: its frames have its own name, or its vehicle's too if that is taken."""
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
        if len(self._vehicles) > 1 and (vehicle := self._carrier(source)):
            prefix, name = f"{ros_name(vehicle)}/", ros_name(source.rpartition("/")[2])
        return CameraFrames(f"{prefix}{name}_link", f"{prefix}{name}_optical_frame")

    def vehicle(self, source: str) -> str:
        """Return the vehicle that a source belongs to: else the first; empty if there is none."""
        return self._carrier(source) or (self._vehicles[0] if self._vehicles else "")

    def name(self, frame_id: str, source: str = "") -> str:
        """Return what ROS calls a frame that a source speaks of."""
        if frame_id == "map":
            return frame_id
        camera = self.camera(frame_id)
        if camera is not None:
            return camera.optical
        if len(self._vehicles) > 1:
            return f"{ros_name(self.vehicle(source))}/{frame_id}"
        return frame_id

    def axes(self, frame_id: str) -> Axes:
        """Return how a frame's axes lie."""
        return "optical" if frame_id in self._cameras else axes_of(frame_id)

    def _carrier(self, source: str) -> str:
        for vehicle in self._vehicles:
            if source == vehicle or source.startswith(f"{vehicle}/"):
                return vehicle
        return ""
