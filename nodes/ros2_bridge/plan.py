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
from nodes.ros2_bridge.frames import Axes
from nodes.ros2_bridge.keys import Qos, ros_name, topic_name
from nodes.ros2_bridge.settings import Kind, Ros2BridgeConfig

What = Literal[
    "image",
    "mono",
    "info",
    "compressed",
    "depth",
    "depth_info",
    "segmentation",
    "cloud",
    "imu",
    "odometry",
    "pose",
    "estimate",
    "score",
    "range",
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
    "segmentation": ("{}/segmentation/image_raw", "sensor_msgs/msg/Image", "segmentation"),
    "cloud": ("{}/points", "sensor_msgs/msg/PointCloud2", "clouds"),
    "imu": ("{}/imu", "sensor_msgs/msg/Imu", "imu"),
    "odometry": ("{}/odom", "nav_msgs/msg/Odometry", "odometry"),
    "pose": ("{}/pose", "geometry_msgs/msg/PoseStamped", "poses"),
    "estimate": ("{}/pose", "geometry_msgs/msg/PoseStamped", "estimates"),
    "score": ("scores/{}", "std_msgs/msg/Float64", "scores"),
    "range": ("{}/range", "sensor_msgs/msg/Range", "ranges"),
    "tf": ("/tf", "tf2_msgs/msg/TFMessage", "tf"),
    "tf_static": ("/tf_static", "tf2_msgs/msg/TFMessage", "tf"),
    "clock": ("/clock", "rosgraph_msgs/msg/Clock", "clock"),
}

_QOS: dict[What, Qos] = {
    "tf": Qos(depth=100),
    "tf_static": Qos(depth=1, transient_local=True),
    "clock": Qos(depth=1, reliable=False),
}

_PICTURES: set[What] = {
    "image", "mono", "info", "compressed", "depth", "depth_info", "segmentation", "cloud"
}  # fmt: skip


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
    pictures = Qos(depth=5, reliable=config.image_qos == "reliable")
    return Publication(
        what=what,
        source=source,
        topic=full if given is None else topic_name(config.namespace, given),
        type=type_,
        qos=pictures if what in _PICTURES else _QOS.get(what, Qos()),
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
            whats = ["odometry"]
        case EstimatorAnnouncement():
            whats = ["estimate"]
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
        yield from ("depth", "depth_info")
    if "segmentation" in images:
        yield "segmentation"


class CameraFrames(msgspec.Struct, frozen=True):
    """A camera's two frames in ROS (REP 103): ``camera_link`` and ``camera_optical_frame``."""

    link: str
    optical: str


class FrameNames:
    """Our frames' names and axes, and what ROS calls them."""

    def __init__(self) -> None:
        self._cameras: dict[str, CameraFrames] = {}
        """By optical frame."""

    def add(self, camera: CameraAnnouncement) -> CameraFrames:
        """Take in a camera: its frames have its own name, or its vehicle's too if that is taken."""
        known = self._cameras.get(camera.frame_id)
        if known is not None:
            return known
        name = ros_name(camera.source.rpartition("/")[2])
        if any(each.link == f"{name}_link" for each in self._cameras.values()):
            name = ros_name(camera.source).replace("/", "_")
        frames = CameraFrames(f"{name}_link", f"{name}_optical_frame")
        self._cameras[camera.frame_id] = frames
        return frames

    def camera(self, frame_id: str) -> CameraFrames | None:
        """Return the frames of the camera with this optical frame, if there is one."""
        return self._cameras.get(frame_id)

    def name(self, frame_id: str) -> str:
        """Return what ROS calls a frame."""
        camera = self._cameras.get(frame_id)
        return frame_id if camera is None else camera.optical

    def axes(self, frame_id: str) -> Axes:
        """Return how a frame's axes lie."""
        if frame_id == "map":
            return "world"
        known = frame_id in self._cameras or frame_id.endswith("_optical")
        return "optical" if known else "body"
