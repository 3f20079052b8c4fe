"""Which messages an event becomes, and on which topics they are put.

Where the messages go is up to a `Sink`: the bridge's Zenoh session, or a recording's file. The
functions in `Publishing.large` take long (images, point clouds) and may run in threads, one for
each type of event; the rest takes microseconds.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeVar

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Image,
    Imu,
    LidarScan,
    MagneticField,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Range,
    Score,
    SegmentationImage,
    TrackedFeatures,
    TransformStamped,
    VehicleAnnouncement,
    Wind,
)
from events.frames import convert_points
from nodes.ros2.messages.images import (
    CloudWriter,
    CompressedDepthWriter,
    CompressedWriter,
    ImageWriter,
)
from nodes.ros2.messages.messages import Messages, Transform
from nodes.ros2.messages.paths import Paths
from nodes.ros2.messages.publications import (
    TOPICS,
    Publication,
    TopicKind,
    announced_topics,
    publication,
)
from nodes.ros2.messages.topics import FrameNames, PublishingConfig, Topic, topic_name
from nodes.ros2.messages.transforms import Transforms
from nodes.ros2.messages.typestore import MessageBuilder, Time, TypeStore

LARGE: tuple[type[Event], ...] = (
    Image,
    DepthImage,
    SegmentationImage,
    PointCloud,
    LidarScan,
)
"""Events whose messages take long to make: `Publishing.large` has a function for each."""

SMALL: tuple[type[Event], ...] = (
    *(Odometry, PoseStamped, PoseEstimate, TransformStamped, Score, TrackedFeatures),
    *(Imu, Range, FluidPressure, MagneticField, NavSatFix, Wind),
)
"""Events that `Publishing.small` takes."""


class Publisher(Protocol):
    """Takes the messages of one topic."""

    @property
    def topic(self) -> Topic:
        """Return the topic."""

    @property
    def wanted(self) -> bool:
        """Tell whether messages are to be made at all; large ones cost time."""

    def put(self, message: bytearray) -> None:
        """Take a message as CDR, whose bytes may be overwritten afterwards."""


E = TypeVar("E", bound=Event)
P = TypeVar("P", bound=Publisher)
P_co = TypeVar("P_co", bound=Publisher, covariant=True)


class Sink(Protocol[P_co]):
    """Where messages go."""

    def publisher(self, topic: Topic) -> P_co:
        """Declare a topic."""


class Publishing(Generic[P]):
    """Makes messages of events, and puts them where they belong.

    Args:
        time: Returns the time in messages of a stamp (ns).
    """

    def __init__(
        self,
        sink: Sink[P],
        store: TypeStore,
        config: PublishingConfig,
        time: Callable[[int], Time],
    ) -> None:
        self._sink = sink
        self._store = store
        self._config = config
        self._time = time
        self.names = FrameNames()
        """What ROS calls the frames of the run."""
        self.builder = MessageBuilder(store, self.names, time)
        """For mappings of the user's own."""
        self._messages = Messages(store, self.names)
        self._transforms = Transforms(self.names, config.vehicle, config.tf)
        self._cameras: dict[str, CameraAnnouncement] = {}
        self._announced: dict[tuple[TopicKind, str], Announcement] = {}
        """By kind and source of the topic."""
        self._bodies: set[str] = set()
        self._vehicles: list[str] = []
        self._estimators: list[str] = []
        self._publishers: dict[tuple[TopicKind, str], P | None] = {}
        self._writers: dict[tuple[TopicKind, str, str, str], Any] = {}
        """By kind and source of the topic, frame and encoding."""
        self._paths = Paths(store, self.names, config)
        self._lock = threading.Lock()
        self.large: dict[type[Event], Callable[[Any], None]] = {
            Image: self._image,
            DepthImage: self._depth,
            SegmentationImage: self._segmentation,
            PointCloud: self._cloud,
            LidarScan: self._lidar,
        }
        """What puts the messages of images and point clouds, by type of event."""
        messages = self._messages
        self._small: dict[type[Event], Callable[[Any], None]] = {
            Odometry: self._odometry,
            PoseStamped: self._pose,
            PoseEstimate: self._estimate,
            TransformStamped: self._transform,
            Imu: self._imu,
            Range: lambda event: self._measured("range", event, messages.range),
            FluidPressure: lambda event: self._measured("pressure", event, messages.pressure),
            MagneticField: lambda event: self._measured("magnetic", event, messages.magnetic_field),
            NavSatFix: self._fix,
            Wind: lambda event: self._plain("wind", event, messages.wind),
            Score: self._score,
            TrackedFeatures: self.names.vehicles.tracked,  # no message: whose estimates they are
        }

    @property
    def publishers(self) -> list[P]:
        """Return what was declared so far."""
        return [each for each in self._publishers.values() if each is not None]

    def announced(self, announcement: Announcement) -> None:
        """Declare the topics of what a node announced."""
        if isinstance(announcement, CameraAnnouncement):
            self._cameras[announcement.source] = announcement
        elif isinstance(announcement, BodyAnnouncement):
            self._bodies.add(announcement.source)
        elif isinstance(announcement, VehicleAnnouncement):
            self._vehicles.append(announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        self._transforms.announced(announcement)
        for found in announced_topics(announcement, self._config):
            self._declare(found)
            self._announced[found.kind, found.source] = announcement

    def warm_up(self) -> None:
        """Make everything that a first message needs, while there is time."""
        for type_ in {found for _, found, _ in TOPICS.values()}:
            self._store.hash(type_)

    def begin(self) -> None:
        """Put what holds for the whole run."""
        self._put_static()

    def unannounced(self) -> Iterator[str]:
        """Yield a line for each setting that names what nobody announced."""
        config = self._config
        for setting, name, known, what in (
            ("vehicle", config.vehicle, self._vehicles, "a vehicle"),
            ("tf", "" if config.tf == "truth" else config.tf, self._estimators, "an estimator"),
        ):
            if name and name not in known:
                yield (
                    f'{setting}: expected {what} that is announced, found "{name}" '
                    f"(there are: {', '.join(known) or 'none'})"
                )

    def unused(self) -> Iterator[str]:
        """Yield a line for each new name that no topic got."""
        names = {each.topic.name for each in self.publishers}
        for given, name in self._config.topics.items():
            if topic_name(self._config.namespace, name) not in names:
                yield f'topics: expected the name of a topic, found "{given}", which none has'

    def knows(self, kind: type[Event]) -> bool:
        """Tell whether `small` has a message for events of a type."""
        return issubclass(kind, SMALL)

    def small(self, event: Event) -> None:
        """Put the messages of an event that is no image and no point cloud."""
        kind = type(event)
        put = self._small.get(kind)
        if put is None:  # a subclass of a node's own
            put = next(put for base, put in self._small.items() if issubclass(kind, base))
            self._small[kind] = put
        put(event)

    def clock(self, now: int) -> None:
        """Put the time (ns)."""
        if publisher := self._publisher("clock", ""):
            publisher.put(self._messages.clock(self._time(now)))

    # Images and point clouds, each with its camera's calibration before it.

    def _image(self, event: Image) -> None:
        self._info("info", event)
        config = self._config
        if config.raw_images:
            self._raw("image", event, event.encoding)
        if form := config.compressed_images:
            self._pixels(
                "compressed",
                event,
                lambda frame: CompressedWriter(self._store, frame, form, config.jpeg_quality),
            )

    def _depth(self, event: DepthImage) -> None:
        self._info("depth_info", event)
        config = self._config
        if config.raw_depth:
            self._raw("depth", event, "16UC1" if config.raw_depth == "millimetres" else "32FC1")
        if config.compressed_depth:
            self._pixels(
                "compressed_depth",
                event,
                lambda frame: CompressedDepthWriter(
                    self._store,
                    frame,
                    inverse=config.compressed_depth == "inverse",
                    farthest=config.depth_max,
                    quantization=config.depth_quantization,
                ),
            )

    def _segmentation(self, event: SegmentationImage) -> None:
        self._raw("segmentation", event, "32SC1")

    def _raw(
        self, kind: TopicKind, event: Image | DepthImage | SegmentationImage, encoding: str
    ) -> None:
        self._pixels(kind, event, lambda frame: ImageWriter(self._store, frame, encoding), encoding)

    def _pixels(
        self,
        kind: TopicKind,
        event: Image | DepthImage | SegmentationImage,
        make: Callable[[str], Any],
        encoding: str = "",
    ) -> None:
        """Put an image by a writer, which `make` makes of the frame's name if it is not there."""
        if publisher := self._publisher(kind, event.source):
            frame = self.names.name(event.frame_id, event.source)
            key = kind, event.source, frame, encoding
            if (writer := self._writers.get(key)) is None:
                writer = self._writers[key] = make(frame)
            publisher.put(writer.write(self._time(event.stamp), event.data))

    def _cloud(self, event: PointCloud) -> None:
        self._points("cloud", event, lambda cloud, *to: cloud.cloud(*to, event.colors))

    def _lidar(self, event: LidarScan) -> None:
        self._points("lidar", event, lambda cloud, *to: cloud.scan(*to, event))

    def _points(
        self, kind: TopicKind, event: PointCloud | LidarScan, write: Callable[..., bytearray]
    ) -> None:
        if publisher := self._publisher(kind, event.source):
            frame = self.names.name(event.frame_id, event.source)
            points = convert_points(self.names.axes(event.frame_id), event.points)
            writer = CloudWriter(self._store, frame)
            publisher.put(write(writer, self._time(event.stamp), points))

    def _info(self, kind: TopicKind, event: Image | DepthImage) -> None:
        camera = self._cameras.get(event.source)
        if camera is not None and (publisher := self._publisher(kind, event.source)):
            publisher.put(self._messages.camera_info(self._time(event.stamp), camera))

    # What is small.

    def _odometry(self, event: Odometry) -> None:
        """Put a body's pose and twist, and where that puts ``base_link``."""
        self._plain("odometry", event, self._messages.odometry)
        self._tf(event, self._transforms.odometry)
        self._path(event)

    def _pose(self, event: PoseStamped) -> None:
        """Put a pose: of a camera's optical frame, or of a body that moves by itself."""
        camera = self._cameras.get(event.source)
        axes = "body" if camera is None else self.names.axes(camera.frame_id)
        kind: TopicKind = "body_pose" if event.source in self._bodies else "pose"
        self._plain(kind, event, lambda time, each: self._messages.pose(time, each, axes))
        self._tf(event, self._transforms.pose)

    def _estimate(self, event: PoseEstimate) -> None:
        child = self.names.axes(event.child_frame_id)
        make: Callable[..., bytearray] = self._messages.pose
        if self._config.covariance:
            make = self._messages.pose_with_covariance
        self._plain("estimate", event, lambda time, each: make(time, each, child))
        self._tf(event, self._transforms.estimate)
        self._path(event)

    def _transform(self, event: TransformStamped) -> None:
        """Put a transform that a node sent, unless the tree of frames has it already."""
        if not event.static:
            self._tf(event, self._transforms.moving)
        elif self._transforms.add_static(event):
            self._put_static()

    def _imu(self, event: Imu) -> None:
        self._measured("imu", event, self._messages.imu)

    def _fix(self, event: NavSatFix) -> None:
        """Put where a receiver is, and how fast it moves."""
        self._measured("fix", event, self._messages.fix)
        self._plain("fix_velocity", event, self._messages.fix_velocity)

    def _measured(self, kind: TopicKind, event: Event, make: Callable[..., bytearray]) -> None:
        """Put a measurement by a function that wants to know what its sensor announced."""
        sensor = self._announced.get((kind, event.source))
        self._plain(kind, event, lambda time, each: make(time, each, sensor))

    def _score(self, event: Score) -> None:
        """Put a number, on a topic of its subject and metric."""
        if publisher := self._publisher("score", f"{event.subject}/{event.metric}"):
            publisher.put(self._messages.score(event))

    def _plain(self, kind: TopicKind, event: Event, make: Callable[[Time, Any], bytearray]) -> None:
        """Put the one message of an event."""
        if publisher := self._publisher(kind, event.source):
            publisher.put(make(self._time(event.stamp), event))

    def _path(self, event: Odometry | PoseEstimate) -> None:
        """Put the path of a source if that is due."""
        if publisher := self._publisher("path", event.source):
            message = self._paths.message(event, self._time(event.stamp))
            if message is not None:
                publisher.put(message)

    def _tf(self, event: E, place: Callable[[E], Sequence[Transform]]) -> None:
        if (publisher := self._publisher("tf", "")) and (transforms := place(event)):
            publisher.put(self._messages.transforms(self._time(event.stamp), transforms))

    def _put_static(self) -> None:
        transforms = self._transforms.static()
        if transforms and (publisher := self._publisher("tf_static", "")):
            publisher.put(self._messages.transforms(self._time(0), transforms))

    def _publisher(self, kind: TopicKind, source: str) -> P | None:
        """Return a publisher that wants messages, declared now if nobody announced the source."""
        try:
            publisher = self._publishers[kind, source]
        except KeyError:
            found = publication(kind, source, self._config)
            publisher = None if found is None else self._declare(found)
            self._publishers[kind, source] = publisher
        return publisher if publisher is not None and publisher.wanted else None

    def _declare(self, found: Publication) -> P:
        with self._lock:  # two threads may want one for the first time together
            key = (found.kind, found.source)
            known = self._publishers.get(key)
            if known is None:
                hash_ = self._store.hash(found.type)
                topic = Topic(name=found.topic, type=found.type, hash=hash_, qos=found.qos)
                known = self._publishers[key] = self._sink.publisher(topic)
            return known
