"""Which topics are published for what nodes announce: names, types and quality of service."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from events import (
    Announcement,
    BarometerAnnouncement,
    BodyAnnouncement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    ImuAnnouncement,
    LidarAnnouncement,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    RangeAnnouncement,
    VehicleAnnouncement,
)
from nodes.ros2.messages.topics import PublishingConfig, Qos, TopicGroup, ros_name, topic_name

TopicKind = str
"""A kind of topic: a key of `TOPICS`."""

TOPICS: dict[TopicKind, tuple[str, str, TopicGroup]] = {
    "image": ("{}/image_raw", "sensor_msgs/msg/Image", "images"),
    "info": ("{}/camera_info", "sensor_msgs/msg/CameraInfo", "images"),
    "compressed": ("{}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", "images"),
    "depth": ("{}/depth/image_raw", "sensor_msgs/msg/Image", "depth_images"),
    "depth_info": ("{}/depth/camera_info", "sensor_msgs/msg/CameraInfo", "depth_images"),
    "compressed_depth": (
        "{}/depth/image_raw/compressedDepth",
        "sensor_msgs/msg/CompressedImage",
        "depth_images",
    ),
    "segmentation": ("{}/segmentation/image_raw", "sensor_msgs/msg/Image", "segmentation_images"),
    "cloud": ("{}/points", "sensor_msgs/msg/PointCloud2", "point_clouds"),
    "imu": ("{}/imu", "sensor_msgs/msg/Imu", "imu"),
    "odometry": ("{}/odom", "nav_msgs/msg/Odometry", "odometry"),
    "pose": ("{}/pose", "geometry_msgs/msg/PoseStamped", "camera_poses"),
    "estimate": ("{}/pose", "geometry_msgs/msg/PoseStamped", "estimates"),
    "score": ("scores/{}", "std_msgs/msg/Float64", "scores"),
    "range": ("{}/range", "sensor_msgs/msg/Range", "ranges"),
    "pressure": ("{}/pressure", "sensor_msgs/msg/FluidPressure", "pressures"),
    "magnetic": ("{}/mag", "sensor_msgs/msg/MagneticField", "magnetic_fields"),
    "fix": ("{}/fix", "sensor_msgs/msg/NavSatFix", "fixes"),
    "fix_velocity": ("{}/vel", "geometry_msgs/msg/TwistStamped", "fixes"),
    "lidar": ("{}/points", "sensor_msgs/msg/PointCloud2", "lidar_scans"),
    "wind": ("{}/wind", "geometry_msgs/msg/Vector3Stamped", "wind"),
    "body_pose": ("{}/pose", "geometry_msgs/msg/PoseStamped", "body_poses"),
    "path": ("{}/path", "nav_msgs/msg/Path", "paths"),
    "tf": ("/tf", "tf2_msgs/msg/TFMessage", "transforms"),
    "tf_static": ("/tf_static", "tf2_msgs/msg/TFMessage", "transforms"),
    "clock": ("/clock", "rosgraph_msgs/msg/Clock", "clock"),
}

_QOS: dict[TopicKind, Qos] = {
    "tf": Qos(depth=100),
    "tf_static": Qos(depth=1, transient_local=True),
    "clock": Qos(depth=1, reliable=False),
    "path": Qos(depth=1),
}

IMAGES: tuple[TopicKind, ...] = (
    "image", "compressed", "depth", "compressed_depth", "segmentation", "lidar",
)  # fmt: skip
"""Of which an estimator subscribes to one at least."""

_SENSORS: set[TopicKind] = {
    *IMAGES, "info", "depth_info", "imu", "range", "pressure", "magnetic", "fix", "fix_velocity",
}  # fmt: skip
"""With the quality of service of rclcpp's ``SensorDataQoS``."""


_KINDS: dict[type[Announcement], TopicKind] = {
    ImuAnnouncement: "imu",
    BarometerAnnouncement: "pressure",
    MagnetometerAnnouncement: "magnetic",
    RangeAnnouncement: "range",
    LidarAnnouncement: "lidar",
    BodyAnnouncement: "body_pose",
}
"""What is announced with one topic."""


class Publication(msgspec.Struct, frozen=True, kw_only=True):
    """A topic to publish.

    Attributes:
        kind: Kind of message.
        source: Of the events that become its messages.
        topic: Full name.
        type: Of its messages.
        qos: Quality of service.
    """

    kind: TopicKind
    source: str
    topic: str
    type: str
    qos: Qos


def publication(kind: TopicKind, source: str, config: PublishingConfig) -> Publication | None:
    """Return the topic for the events of a source; `None` if it is not to be published."""
    pattern, type_, group = TOPICS[kind]
    if group not in config.publish or (kind == "clock" and config.time == "wall"):
        return None
    name = pattern.format(ros_name(source))
    above, _, last = name.rpartition("/")
    if kind in _SENSORS and above.endswith(f"/{last}"):  # /drone/imu, not /drone/imu/imu
        name = above
    full = topic_name(config.namespace, name)
    given = config.topics.get(full, config.topics.get(name))
    if kind == "estimate" and config.covariance:
        type_ = "geometry_msgs/msg/PoseWithCovarianceStamped"
    sensors = Qos(depth=5, reliable=config.sensor_qos == "reliable")
    return Publication(
        kind=kind,
        source=source,
        topic=full if given is None else topic_name(config.namespace, given),
        type=type_,
        qos=sensors if kind in _SENSORS else _QOS.get(kind, Qos()),
    )


def announced_topics(announcement: Announcement, config: PublishingConfig) -> Iterator[Publication]:
    """Yield the topics for what a node announced."""
    kinds: list[TopicKind] = []
    extra: list[tuple[TopicKind, str]] = []
    match announcement:
        case CameraAnnouncement(images=images):
            kinds = [*camera_topics(images, config), "pose"]
            if {"rgb", "grey"} <= {*images}:  # which it sends as images of another source
                grey = f"{announcement.source}/grey"
                extra = [(kind, grey) for kind in kinds if kind in {"image", "compressed"}]
        case VehicleAnnouncement():
            kinds = ["odometry", "path"]
        case EstimatorAnnouncement():
            kinds = ["estimate", "path"]
        case NavSatAnnouncement():
            kinds = ["fix", "fix_velocity"]
        case _:
            kinds = [kind for of, kind in _KINDS.items() if isinstance(announcement, of)]
    for kind, source in [*((kind, announcement.source) for kind in kinds), *extra]:
        if found := publication(kind, source, config):
            yield found


def camera_topics(images: tuple[str, ...], config: PublishingConfig) -> Iterator[TopicKind]:
    """Yield the topics for the images that a camera gives."""
    if "rgb" in images or "grey" in images:
        yield "info"
        if config.raw_images:
            yield "image"
        if config.compressed_images:
            yield "compressed"
    if "depth" in images:
        yield "depth_info"
        if config.raw_depth:
            yield "depth"
        if config.compressed_depth:
            yield "compressed_depth"
    if "segmentation" in images:
        yield "segmentation"
