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
from nodes.ros2_bridge.settings import Kind, Ros2BridgeConfig
from nodes.ros_messages.topics import Qos, ros_name, topic_name

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
