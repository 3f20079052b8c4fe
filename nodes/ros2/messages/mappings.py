"""Table of all mappings between events and ROS messages, and the publishing of events by it.

A row's function is in `outgoing` or `incoming`. Messages go to a `Sink`: a session, a file or
a server.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import groupby
from typing import Any, Generic, Protocol, TypeVar, get_type_hints

import msgspec

from events import (
    Announcement,
    BarometerAnnouncement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Image,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    PoseSetpoint,
    PoseStamped,
    PositionSetpoint,
    Range,
    RangeAnnouncement,
    Score,
    SegmentationImage,
    TrackedFeatures,
    TransformStamped,
    VehicleAnnouncement,
    VelocitySetpoint,
    Wind,
)
from events.sensors import SensorKind
from nodes.ros2.messages import incoming, outgoing
from nodes.ros2.messages.incoming import Reader
from nodes.ros2.messages.outgoing import Outgoing
from nodes.ros2.messages.topics import (
    ALL_GROUPS,
    PublishingConfig,
    Qos,
    Topic,
    TopicGroup,
    ros_name,
    topic_name,
)
from nodes.ros2.messages.typestore import MessageBuilder, Time, TypeStore
from runtime.sensors import sensor_kinds

TopicKind = str  # the `kind` of a mapping
Kind = type[Event]
Events = tuple[Kind, ...]

_CAMERA_INFO, _IMAGE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image"
_COMPRESSED, _POINTS = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"
_ODOMETRY, _TREE = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_POSE, _TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SENSOR = Qos(depth=5, reliable=False)  # as of rclcpp's ``SensorDataQoS``; see `sensor_qos`
_COLOURS, _DEPTH = ("rgb", "grey"), ("depth",)


def _source(_: Outgoing, event: Event) -> str:
    return event.source


def _of_camera(out: Outgoing, event: Event) -> str | None:
    return event.source if event.source in out.cameras else None


def _always(_: PublishingConfig) -> bool:
    return True


class Mapping(msgspec.Struct, frozen=True):
    """Mapping between events and a type of ROS message: published, read, or both."""

    kind: TopicKind = ""  # name of the publication
    topic: str = ""  # with `{}` for the source of the events
    type: str = ""
    group: TopicGroup = "transforms"  # in the setting ``publish``
    events: Events = ()  # published events; an event of several rows goes by the order of the table
    write: Callable[[Outgoing, Any], Any] = outgoing.nothing
    announced: Events = ()  # announcements for which the topic is there from the start
    gives: tuple[str, ...] = ()  # kinds of image of which a camera has to give at least one
    qos: Qos = Qos()
    large: bool = False  # whether a message takes long to make
    image: bool = False  # whether an estimator may subscribe to it for its images
    # Returns the text for `{}`; `None` for an event without such a message.
    source: Callable[[Outgoing, Any], str | None] = _source
    # Whether settings allow its publication, beside `group`.
    wanted: Callable[[PublishingConfig], object] = _always
    use: str = ""  # use of the messages, as settings name it
    read: Reader = incoming.nothing
    becomes: Kind | None = None  # type of the events that are read, if it is not `events`
    bags: bool = False  # whether only replays of bags read it


# fmt: off
_OWN = (
    # Images and point clouds, each with its camera's calibration before it.
    Mapping("info", "{}/camera_info", _CAMERA_INFO, "images", (Image,), outgoing.camera_info,
            (CameraAnnouncement,), _COLOURS, _SENSOR, large=True, source=_of_camera, use="camera"),
    Mapping("image", "{}/image_raw", _IMAGE, "images", (Image,), outgoing.image,
            (CameraAnnouncement,), _COLOURS, _SENSOR, large=True, image=True,
            wanted=lambda config: config.raw_images, use="image", read=incoming.image),
    Mapping("compressed", "{}/image_raw/compressed", _COMPRESSED, "images",
            (Image,), outgoing.compressed_image,
            (CameraAnnouncement,), _COLOURS, _SENSOR, large=True, image=True,
            wanted=lambda config: config.compressed_images,
            use="image", read=incoming.image, bags=True),
    Mapping("depth_info", "{}/depth/camera_info", _CAMERA_INFO, "depth_images",
            (DepthImage,), outgoing.camera_info,
            (CameraAnnouncement,), _DEPTH, _SENSOR, large=True, source=_of_camera),
    Mapping("depth", "{}/depth/image_raw", _IMAGE, "depth_images", (DepthImage,), outgoing.depth,
            (CameraAnnouncement,), _DEPTH, _SENSOR, large=True, image=True,
            wanted=lambda config: config.raw_depth, use="depth", read=incoming.depth),
    Mapping("compressed_depth", "{}/depth/image_raw/compressedDepth", _COMPRESSED, "depth_images",
            (DepthImage,), outgoing.compressed_depth,
            (CameraAnnouncement,), _DEPTH, _SENSOR, large=True, image=True,
            wanted=lambda config: config.compressed_depth,
            use="depth", read=incoming.depth, bags=True),
    Mapping("segmentation", "{}/segmentation/image_raw", _IMAGE, "segmentation_images",
            (SegmentationImage,), outgoing.segmentation,
            (CameraAnnouncement,), ("segmentation",), _SENSOR, large=True, image=True),
    Mapping("cloud", "{}/points", _POINTS, "point_clouds", (PointCloud,), outgoing.cloud,
            large=True),
    Mapping("lidar", "{}/points", _POINTS, "lidar_scans", (LidarScan,), outgoing.lidar,
            (LidarAnnouncement,), qos=_SENSOR, large=True, image=True),
    # True, estimated and planned poses.
    Mapping("odometry", "{}/odom", _ODOMETRY, "odometry", (Odometry,), outgoing.odometry,
            (VehicleAnnouncement,), use="odometry", read=incoming.odometry),
    Mapping("pose", "{}/pose", _POSE, "camera_poses", (PoseStamped,), outgoing.pose,
            (CameraAnnouncement,),
            source=lambda out, event: None if event.source in out.bodies else event.source),
    Mapping("body_pose", "{}/pose", _POSE, "body_poses", (PoseStamped,), outgoing.pose,
            (BodyAnnouncement,),
            source=lambda out, event: event.source if event.source in out.bodies else None),
    Mapping("estimate", "{}/pose", _POSE, "estimates", (PoseEstimate,), outgoing.estimate,
            (EstimatorAnnouncement,), wanted=lambda config: not config.covariance,
            use="estimate", read=incoming.estimate),
    Mapping("estimate", "{}/pose", _COVARIANCE, "estimates",
            (PoseEstimate,), outgoing.estimate_with_covariance,
            (EstimatorAnnouncement,), wanted=lambda config: config.covariance,
            use="estimate", read=incoming.estimate_with_covariance),
    Mapping("tf", "/tf", _TREE, "transforms",
            (Odometry, PoseStamped, PoseEstimate, TransformStamped), outgoing.transforms,
            qos=Qos(depth=100),
            source=lambda _, event: None if getattr(event, "static", False) else ""),
    Mapping("tf_static", "/tf_static", _TREE, "transforms", (), outgoing.fixed_transforms,
            qos=Qos(depth=1, transient_local=True)),
    Mapping("path", "{}/path", "nav_msgs/msg/Path", "paths",
            (Odometry, PoseEstimate), outgoing.path,
            (VehicleAnnouncement, EstimatorAnnouncement), qos=Qos(depth=1),
            use="estimate", read=incoming.newest, becomes=PoseEstimate),
    Mapping(type=_ODOMETRY, becomes=PoseEstimate,
            use="estimate", read=incoming.estimate_with_covariance),
    Mapping(type=_ODOMETRY, becomes=Odometry,
            use="truth", read=incoming.true_odometry, bags=True),
    Mapping(type=_POSE, becomes=Odometry, use="truth", read=incoming.true_pose, bags=True),
    Mapping(type="geometry_msgs/msg/TransformStamped", becomes=Odometry,
            use="truth", read=incoming.true_transform, bags=True),
    Mapping(type="geometry_msgs/msg/Twist", becomes=VelocitySetpoint,
            use="velocity", read=incoming.velocity),
    Mapping(type=_TWIST, becomes=VelocitySetpoint,
            use="velocity", read=incoming.stamped_velocity),
    Mapping(type=_POSE, becomes=PositionSetpoint, use="position", read=incoming.position),
    Mapping(type=_POSE, becomes=PoseSetpoint, use="pose", read=incoming.pose),
    # Measurements of small sensors.
    Mapping("imu", "{}/imu", "sensor_msgs/msg/Imu", "imu", (Imu,), outgoing.imu,
            (ImuAnnouncement,), qos=_SENSOR, use="imu", read=incoming.imu),
    Mapping("range", "{}/range", "sensor_msgs/msg/Range", "ranges", (Range,), outgoing.distance,
            (RangeAnnouncement,), qos=_SENSOR, use="range", read=incoming.distance),
    Mapping("pressure", "{}/pressure", "sensor_msgs/msg/FluidPressure", "pressures",
            (FluidPressure,), outgoing.pressure,
            (BarometerAnnouncement,), qos=_SENSOR, use="pressure", read=incoming.pressure),
    Mapping("magnetic", "{}/mag", "sensor_msgs/msg/MagneticField", "magnetic_fields",
            (MagneticField,), outgoing.magnetic_field, (MagnetometerAnnouncement,),
            qos=_SENSOR, use="magnetic_field", read=incoming.magnetic_field),
    Mapping("fix", "{}/fix", "sensor_msgs/msg/NavSatFix", "fixes", (NavSatFix,), outgoing.fix,
            (NavSatAnnouncement,), qos=_SENSOR, use="fix", read=incoming.fix),
    Mapping("fix_velocity", "{}/vel", _TWIST, "fixes", (NavSatFix,), outgoing.fix_velocity,
            (NavSatAnnouncement,), qos=_SENSOR),
    Mapping("wind", "{}/wind", "geometry_msgs/msg/Vector3Stamped", "wind", (Wind,), outgoing.wind),
    # The rest.
    Mapping("score", "scores/{}", "std_msgs/msg/Float64", "scores", (Score,), outgoing.score,
            source=lambda _, event: f"{event.subject}/{event.metric}"),
    Mapping("clock", "/clock", "rosgraph_msgs/msg/Clock", "clock", (), outgoing.clock,
            qos=Qos(depth=1, reliable=False), wanted=lambda config: config.time == "simulated"),
    Mapping(type="std_msgs/msg/Header", use="done"),
    Mapping(type="builtin_interfaces/msg/Time", use="done"),
)
# fmt: on


def _plain(kind: SensorKind) -> Iterator[Mapping]:
    """Yield the rows of a sensor without a message of its own: a topic for each measured field."""
    hints = get_type_hints(kind.event)
    for field in kind.fields:
        name, write = "std_msgs/msg/Float64", outgoing.number
        if hints[field] is not float:
            name, write = "geometry_msgs/msg/Vector3Stamped", outgoing.vector
        yield Mapping(
            f"{kind.group}.{field}",
            f"{{}}/{field}",
            name,
            kind.group,
            (kind.event,),
            partial(write, field=field),
            (kind.announcement,),
            qos=_SENSOR,
        )


_MAPPED = {event for row in _OWN for event in row.events}
MAPPINGS = (
    *_OWN,
    *(row for kind in sensor_kinds() if kind.event not in _MAPPED for row in _plain(kind)),
)
"""The table: the project's rows, then those of sensors that have none among them."""

PUBLISHED = tuple(row for row in MAPPINGS if row.kind)  # rows of the messages made of events
READERS = {(row.type, row.use): row for row in MAPPINGS if row.use}  # by type of message and use
RECEIVED: dict[str, type[Event]] = {
    row.group: row.events[0]
    for group in ALL_GROUPS
    for row in MAPPINGS
    if row.group == group and row.use and row.becomes is None
    if row.events and row.read is not incoming.nothing
}  # groups of topics whose messages are also read, and the events that are made of them

_USES = {
    "estimate": "from PoseStamped, PoseWithCovarianceStamped, Odometry or the end of a Path",
    **dict.fromkeys(("odometry", "velocity", "position", "pose", "image", "depth"), ""),
    **dict.fromkeys(("imu", "range", "pressure", "magnetic_field", "fix"), ""),
    "camera": "CameraInfo; the run waits for it, and announces a camera",
    "done": "Header or Time: an estimator is done with the image of this stamp",
}
"""The order in which uses are documented, and what more is said of them than their types; uses that
are not in it follow."""


def described_uses() -> str:
    """Return the uses of messages read by a bridge, each with its types, as a sentence's part."""
    types: dict[str, list[str]] = {use: [] for use in _USES}
    for row in MAPPINGS:
        if row.use and not row.bags:
            types.setdefault(row.use, []).append(row.type.rpartition("/")[2])
    descriptions = {use: _USES.get(use) or ", ".join(names) for use, names in types.items()}
    groups = [
        (", ".join(f"``{u}``" for u in g), w)
        for w, g in groupby(descriptions, descriptions.__getitem__)
    ]
    return ", ".join(f"{uses} ({description})" for uses, description in groups)


LARGE: tuple[type[Event], ...] = tuple(
    dict.fromkeys(event for row in PUBLISHED if row.large for event in row.events)
)  # events with slow messages: made in threads, a thread for each of these types

SMALL: tuple[type[Event], ...] = (
    *dict.fromkeys(event for row in PUBLISHED if not row.large for event in row.events),
    TrackedFeatures,  # no message: it determines the vehicle of an estimator
)  # all other events with messages, and events with an effect on messages


@cache
def rows_of(event: type[Event]) -> tuple[Mapping, ...]:
    """Return the rows of an event type's messages."""
    return tuple(row for row in PUBLISHED if issubclass(event, row.events))


def publication(kind: TopicKind, source: str, config: PublishingConfig) -> Topic | None:
    """Return the topic for the events of a source; `None` if not published."""
    rows = (row for row in PUBLISHED if row.kind == kind and row.group in config.publish)
    row = next((row for row in rows if row.wanted(config)), None)
    if row is None:
        return None
    name, sensor = row.topic.format(ros_name(source)), row.qos is _SENSOR
    above, _, last = name.rpartition("/")
    if sensor and above.endswith(f"/{last}"):  # /drone/imu, not /drone/imu/imu
        name = above
    full = topic_name(config.namespace, name)
    new_name = config.topics.get(full, config.topics.get(name))
    return Topic(
        name=full if new_name is None else topic_name(config.namespace, new_name),
        type=row.type,
        qos=Qos(depth=5) if sensor and config.sensor_qos == "reliable" else row.qos,
    )


def announced_topics(announcement: Announcement) -> Iterator[tuple[TopicKind, str]]:
    """Yield kind and source of the topics for an announcement."""
    source, images = announcement.source, set[str]()
    if isinstance(announcement, CameraAnnouncement):
        images = {*announcement.images}
    kinds = [
        row.kind
        for row in PUBLISHED
        if isinstance(announcement, row.announced)
        and (not row.gives or images.intersection(row.gives))
    ]
    yield from dict.fromkeys((kind, source) for kind in kinds)
    if images >= {"rgb", "grey"}:  # which it sends as images of another source
        yield from ((kind, f"{source}/grey") for kind in ("image", "compressed"))


Write = Callable[[Outgoing, Any], Any]


class Publisher(Protocol):
    """Protocol of a topic's publisher."""

    @property
    def topic(self) -> Topic:
        """Return the topic."""

    @property
    def wanted(self) -> bool:
        """Return whether messages are needed; large ones cost time."""

    def put(self, message: bytearray) -> None:
        """Publish a message in CDR, whose bytes may be overwritten afterwards."""


P = TypeVar("P", bound=Publisher)
P_co = TypeVar("P_co", bound=Publisher, covariant=True)


class Sink(Protocol[P_co]):
    """Protocol of a transport, which declares publishers."""

    def publisher(self, topic: Topic) -> P_co:
        """Declare a topic."""


class Publishing(Generic[P]):
    """Maker and publisher of events' messages; `time` returns a stamp's time in messages."""

    def __init__(
        self, sink: Sink[P], store: TypeStore, config: PublishingConfig, time: Callable[[int], Time]
    ) -> None:
        self._sink, self._store, self._config = sink, store, config
        self._out = Outgoing(store, config, time)
        self.names = self._out.names
        self.builder = MessageBuilder(store, self.names, time)
        self._vehicles: list[str] = []
        self._estimators: list[str] = []
        self._publishers: dict[tuple[TopicKind, str], P | None] = {}
        self._lock = threading.Lock()

    @property
    def publishers(self) -> list[P]:
        """Return the publishers declared so far."""
        return [publisher for publisher in self._publishers.values() if publisher is not None]

    def announced(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        if isinstance(announcement, VehicleAnnouncement):
            self._vehicles.append(announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        self._out.announced(announcement)
        for key in announced_topics(announcement):
            if self._declare(*key) is not None:
                self._out.sensors[key] = announcement

    def warm_up(self) -> None:
        """Compute all type hashes for the first messages, while there is time."""
        for type_ in {row.type for row in PUBLISHED}:
            self._store.hash(type_)

    def unannounced(self) -> Iterator[str]:
        """Yield a line for each setting with an unannounced name."""
        config = self._config
        for setting, name, announced, kind in (
            ("vehicle", config.vehicle, self._vehicles, "a vehicle"),
            ("tf", "" if config.tf == "truth" else config.tf, self._estimators, "an estimator"),
        ):
            if name and name not in announced:
                yield (
                    f'{setting}: expected {kind} that is announced, found "{name}" '
                    f"(there are: {', '.join(announced) or 'none'})"
                )

    def unused(self) -> Iterator[str]:
        """Yield a line for each new name in `topics` without a topic."""
        names = {publisher.topic.name for publisher in self.publishers}
        for old_name, name in self._config.topics.items():
            if topic_name(self._config.namespace, name) not in names:
                yield f'topics: expected the name of a topic, found "{old_name}", which none has'

    def begin(self) -> None:
        """Publish the fixed transforms, for the whole run."""
        if self._out.transforms.static():
            self._put("tf_static", "", outgoing.fixed_transforms, None)

    def clock(self, now: int) -> None:
        """Publish the time (ns)."""
        self._put("clock", "", outgoing.clock, now)

    def put(self, event: Event) -> None:
        """Publish the messages of an event; for `LARGE` events in threads, a thread per type."""
        if isinstance(event, TrackedFeatures):
            self.names.vehicles.tracked(event)
        if isinstance(event, TransformStamped) and self._out.transforms.add_static(event):
            self.begin()
        for row in rows_of(type(event)):
            source = row.source(self._out, event)
            if source is None or not row.wanted(self._config):
                continue
            self._put(row.kind, source, row.write, event)

    def _put(self, kind: TopicKind, source: str, write: Write, value: Any) -> None:
        if publisher := self._publisher(kind, source):
            message = write(self._out, value)
            if message is not None:
                done = isinstance(message, bytearray)
                publisher.put(message if done else self._store.serialize(message))

    def _publisher(self, kind: TopicKind, source: str) -> P | None:
        """Return the source's publisher if in demand, declared now if new; else `None`."""
        try:
            publisher = self._publishers[kind, source]
        except KeyError:
            publisher = self._declare(kind, source)
        return publisher if publisher is not None and publisher.wanted else None

    def _declare(self, kind: TopicKind, source: str) -> P | None:
        with self._lock:  # two threads may declare one at the same time
            if (kind, source) not in self._publishers:
                publisher, topic = None, publication(kind, source, self._config)
                if topic is not None:
                    hashed = msgspec.structs.replace(topic, hash=self._store.hash(topic.type))
                    publisher = self._sink.publisher(hashed)
                self._publishers[kind, source] = publisher
            return self._publishers[kind, source]
