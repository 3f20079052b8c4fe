"""What is published of a run, and how: the settings that all who make ROS messages share."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from nodes.ros2.messages.topics import topic_name
from runtime import NodeConfig

TopicGroup = Literal[
    "images",
    "depth_images",
    "segmentation_images",
    "point_clouds",
    "imu",
    "odometry",
    "camera_poses",
    "transforms",
    "estimates",
    "scores",
    "ranges",
    "pressures",
    "magnetic_fields",
    "fixes",
    "lidar_scans",
    "wind",
    "body_poses",
    "clock",
    "paths",
]

ALL_GROUPS: tuple[TopicGroup, ...] = TopicGroup.__args__  # type: ignore[attr-defined]

Positive = Annotated[int, msgspec.Meta(ge=1)]
Rate = Annotated[float, msgspec.Meta(gt=0)]


class PublishingConfig(NodeConfig):
    """Settings of what is published.

    Attributes:
        namespace: Before all topics' names that do not begin with a slash.
        publish: Which groups of topics are published.
        topics: Other names for topics, by the name that they would have.
        time: ``simulated``: stamps count from the run's start, and ``/clock`` gives the time (set
            ``use_sim_time``). ``wall``: they are shifted to the wall clock, and there is no
            ``/clock``; with the real clock only.
        vehicle: Whose truth ``/tf`` shows; if empty, that of all vehicles which are announced.
            If there are several, their frames begin with the vehicle's name.
        tf: ``truth``, or the source of the estimates that place ``base_link`` instead.
        path_rate: Messages a second, at most, of the path of a vehicle or of an estimate.
        path_step: Metres from one pose of a path to the next.
        path_length: Poses of a path at most; beyond that, every other is left out and the step
            doubled, so that a path always reaches back to its start.
        covariance: Publish estimates as PoseWithCovarianceStamped.
        raw_images: Publish images as ``Image``.
        compressed_images: Publish images as ``CompressedImage`` of this format.
        raw_depth: Publish depth images as ``Image``: in metres (32FC1), or in whole
            ``millimetres`` up to 65.535 m (16UC1).
        compressed_depth: Publish depth images as compressed_depth_image_transport does:
            ``inverse`` depth in 16 bits (32FC1), or whole ``millimetres`` up to 65.535 m (16UC1).
        depth_max: Metres beyond which ``inverse`` depth is unknown.
        depth_quantization: Metres near which steps of ``inverse`` depth are a hundredth of the
            depth; farther away they grow with its square.
        jpeg_quality: 1 to 100.
        sensor_qos: ``best_effort`` (as ROS's sensor data) or ``reliable``, for the topics of
            sensors.
    """

    namespace: str = "/"
    publish: tuple[TopicGroup, ...] = ALL_GROUPS
    topics: dict[str, str] = msgspec.field(default_factory=dict)
    time: Literal["simulated", "wall"] = "simulated"
    vehicle: str = ""
    tf: str = "truth"
    path_rate: Rate = 2.0
    path_step: Rate = 0.05
    path_length: Annotated[int, msgspec.Meta(ge=3, le=1_000_000)] = 1000
    covariance: bool = False
    raw_images: bool = True
    compressed_images: Literal["", "jpeg", "png"] = ""
    raw_depth: bool | Literal["millimetres"] = True
    compressed_depth: Literal["", "inverse", "millimetres"] = ""
    depth_max: Rate = 10.0
    depth_quantization: Rate = 100.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    sensor_qos: Literal["best_effort", "reliable"] = "best_effort"

    def __post_init__(self) -> None:
        if not self.namespace.startswith("/"):
            raise ValueError(f"namespace: expected a leading slash, found {self.namespace!r}")
        if self.namespace != "/":
            check_name("namespace", self.namespace)
        for given, name in self.topics.items():
            check_name(f'topics: "{given}"', name)


def check_name(where: str, name: str) -> None:
    """Make sure that ROS allows a name.

    Raises:
        ValueError: It does not; the message begins with `where`.
    """
    try:
        topic_name("/", name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
