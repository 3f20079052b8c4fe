"""What the bridge says: publishers by source, and which message an event becomes.

Pictures and clouds are put from a thread beside the loop, one of each kind at a time; the rest is
small and put at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Image,
    Imu,
    ImuAnnouncement,
    LaserScan3D,
    MagneticField,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    Range,
    Score,
    SegmentationImage,
    TransformStamped,
    Vector3,
    VehicleAnnouncement,
)
from events.frames import convert_points, convert_rotation, convert_vector
from nodes.ros2_bridge.outgoing_topic import Telling, Writing
from nodes.ros2_bridge.plan import NAMES, Publication, What, announced, publication
from nodes.ros2_bridge.session import Publisher, Session
from nodes.ros2_bridge.settings import Ros2BridgeConfig
from nodes.ros_messages.depth import CompressedDepthWriter
from nodes.ros_messages.frame_names import FrameNames
from nodes.ros_messages.images import CloudWriter, CompressedWriter, ImageWriter
from nodes.ros_messages.messages import Messages, Time
from nodes.ros_messages.paths import Path
from nodes.ros_messages.stamps import SECOND
from nodes.ros_messages.topics import Topic, topic_name
from nodes.ros_messages.transforms import Transforms
from nodes.ros_messages.typestore import TypeStore


class Publishing:
    """Publishers of a session.

    Args:
        session: Where to publish.
        store: Of the types.
        config: The bridge's settings.
        time: Returns a stamp as messages tell it.
    """

    def __init__(
        self,
        session: Session,
        store: TypeStore,
        config: Ros2BridgeConfig,
        time: Callable[[int], Time],
    ) -> None:
        self._session = session
        self._store = store
        self._config = config
        self._time = time
        self._names = FrameNames()
        self._writing = Writing(store, self._names, time)
        self._messages = Messages(store, self._names)
        self._transforms = Transforms(self._names, config.vehicle, config.tf)
        self._cameras: dict[str, CameraAnnouncement] = {}
        self._imus: dict[str, ImuAnnouncement] = {}
        self._vehicles: list[str] = []
        self._estimators: list[str] = []
        self._publishers: dict[tuple[What, str], Publisher | None] = {}
        self._writers: dict[tuple[What, str], Any] = {}
        self._paths: dict[str, tuple[Path, int]] = {}
        """By source: the path, and when it is to be sent again."""
        self._own: dict[Telling, Publisher] = {}
        """What mappings of the user's own make."""
        self._lock = threading.Lock()
        self.large: dict[type[Event], Callable[[Any], None]] = {
            Image: self.image,
            DepthImage: self.depth,
            SegmentationImage: self.segmentation,
            PointCloud: self.cloud,
            LaserScan3D: self.lidar,
        }
        self._small: dict[type[Event], Callable[[Any], None]] = {
            Odometry: self.odometry,
            PoseStamped: self.pose,
            PoseEstimate: self.estimate,
            TransformStamped: self.transform,
            Imu: self.imu,
            Range: self.range,
            FluidPressure: self.pressure,
            MagneticField: self.magnetic_field,
            NavSatFix: self.fix,
            Score: self.score,
        }

    @property
    def publishers(self) -> list[Publisher]:
        """Return what was declared so far."""
        declared = [each for each in self._publishers.values() if each is not None]
        return declared + list(self._own.values())

    def announced(self, announcement: Announcement) -> None:
        """Declare the publishers for what a node announced."""
        if isinstance(announcement, CameraAnnouncement):
            self._cameras[announcement.source] = announcement
        elif isinstance(announcement, ImuAnnouncement):
            self._imus[announcement.source] = announcement
        elif isinstance(announcement, VehicleAnnouncement):
            self._vehicles.append(announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        self._transforms.announced(announcement)
        for found in announced(announcement, self._config):
            self._declare(found)

    def warm_up(self) -> None:
        """Have everything made that a first message needs, while there is time."""
        for type_ in {found for _, found, _ in NAMES.values()}:
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

    def declare(self, telling: Telling) -> None:
        """Declare the publisher of a mapping of the user's own."""
        self._own[telling] = self._session.publisher(telling.topic)

    # Beside the loop.

    def image(self, event: Image) -> None:
        """Put a picture, and its camera's calibration before it."""
        self._info("info", event.stamp, event.source)
        camera = self._cameras.get(event.source)
        grey = event.encoding == "mono8" and camera is not None and "rgb" in camera.images
        if self._config.raw:
            self._picture("mono" if grey else "image", event, event.encoding)
        if self._config.compressed and not grey:
            what: What = "compressed"
            if publisher := self._publisher(what, event.source):
                writer = self._writers.get((what, event.source))
                if writer is None:
                    frame = self._names.name(event.frame_id, event.source)
                    how, quality = self._config.compressed, self._config.jpeg_quality
                    writer = CompressedWriter(self._store, frame, how, quality)
                    self._writers[what, event.source] = writer
                publisher.put(writer.write(self._time(event.stamp), event.data))

    def depth(self, event: DepthImage) -> None:
        """Put a depth image, and its camera's calibration before it."""
        self._info("depth_info", event.stamp, event.source)
        config = self._config
        if config.raw or not config.compressed_depth:
            self._picture("depth", event, "32FC1")
        what: What = "compressed_depth"
        if config.compressed_depth and (publisher := self._publisher(what, event.source)):
            writer = self._writers.get((what, event.source))
            if writer is None:
                frame = self._names.name(event.frame_id, event.source)
                farthest, steps = config.depth_max, config.depth_quantization
                writer = CompressedDepthWriter(self._store, frame, farthest, steps)
                self._writers[what, event.source] = writer
            publisher.put(writer.write(self._time(event.stamp), event.data))

    def segmentation(self, event: SegmentationImage) -> None:
        """Put object numbers."""
        self._picture("segmentation", event, "32SC1")

    def cloud(self, event: PointCloud) -> None:
        """Put a cloud."""
        if publisher := self._publisher("cloud", event.source):
            frame = self._names.name(event.frame_id, event.source)
            points = convert_points(self._names.axes(event.frame_id), event.points)
            writer = CloudWriter(self._store, frame)
            publisher.put(writer.write(self._time(event.stamp), points, event.colors))

    def lidar(self, event: LaserScan3D) -> None:
        """Put a sweep of a lidar."""
        if publisher := self._publisher("lidar", event.source):
            frame = self._names.name(event.frame_id, event.source)
            points = convert_points(self._names.axes(event.frame_id), event.points)
            writer = CloudWriter(self._store, frame, "xyz")
            publisher.put(writer.write(self._time(event.stamp), points))

    def own(self, telling: Telling, event: Event) -> None:
        """Put what a mapping of the user's own makes of an event."""
        message = telling.message(event, self._writing)
        if message is not None:
            self._own[telling].put(message)

    # At once.

    def knows(self, kind: type[Event]) -> bool:
        """Tell whether `small` has a message for events of a type."""
        return issubclass(kind, tuple(self._small))

    def small(self, event: Event) -> None:
        """Put what any of the following functions puts."""
        kind = type(event)
        put = self._small.get(kind)
        if put is None:  # a subclass of a node's own
            put = next(put for base, put in self._small.items() if issubclass(kind, base))
            self._small[kind] = put
        put(event)

    def odometry(self, event: Odometry) -> None:
        """Put a body's pose and twist, and where that puts ``base_link``."""
        time = self._time(event.stamp)
        if publisher := self._publisher("odometry", event.source):
            publisher.put(self._messages.odometry(time, event))
        self._tf(time, self._transforms.odometry(event))
        self._path(event, event.child_frame_id)

    def pose(self, event: PoseStamped) -> None:
        """Put a pose; a camera's is that of its optical frame."""
        time, camera = self._time(event.stamp), self._cameras.get(event.source)
        if publisher := self._publisher("pose", event.source):
            axes = "body" if camera is None else self._names.axes(camera.frame_id)
            publisher.put(self._messages.pose(time, event, axes))
        self._tf(time, self._transforms.pose(event))

    def estimate(self, event: PoseEstimate) -> None:
        """Put an estimate."""
        time = self._time(event.stamp)
        if publisher := self._publisher("estimate", event.source):
            child = self._names.axes(event.child_frame_id)
            make = self._messages.pose
            if self._config.covariance:
                make = self._messages.pose_with_covariance  # type: ignore[assignment]
            publisher.put(make(time, event, child))
        self._tf(time, self._transforms.estimate(event))
        self._path(event, event.child_frame_id)

    def transform(self, event: TransformStamped) -> None:
        """Put a transform that a node sent, unless the bridge makes it itself."""
        if event.static:
            if self._transforms.add_static(event):
                self._put_static()
        else:
            self._tf(self._time(event.stamp), self._transforms.moving(event))

    def imu(self, event: Imu) -> None:
        """Put an inertial measurement."""
        if publisher := self._publisher("imu", event.source):
            noise = self._imus.get(event.source)
            publisher.put(self._messages.imu(self._time(event.stamp), event, noise))

    def range(self, event: Range) -> None:
        """Put a distance."""
        if publisher := self._publisher("range", event.source):
            publisher.put(self._messages.range(self._time(event.stamp), event))

    def pressure(self, event: FluidPressure) -> None:
        """Put a pressure."""
        if publisher := self._publisher("pressure", event.source):
            publisher.put(self._messages.pressure(self._time(event.stamp), event))

    def magnetic_field(self, event: MagneticField) -> None:
        """Put a magnetic field."""
        if publisher := self._publisher("magnetic", event.source):
            publisher.put(self._messages.magnetic_field(self._time(event.stamp), event))

    def fix(self, event: NavSatFix) -> None:
        """Put a place on Earth."""
        if publisher := self._publisher("fix", event.source):
            publisher.put(self._messages.fix(self._time(event.stamp), event))

    def score(self, event: Score) -> None:
        """Put a number, on a topic of its subject and metric."""
        if publisher := self._publisher("score", f"{event.subject}/{event.metric}"):
            publisher.put(self._messages.score(event))

    def clock(self, now: int) -> None:
        """Put the time."""
        if publisher := self._publisher("clock", ""):
            publisher.put(self._messages.clock(self._time(now)))

    def _path(self, event: Odometry | PoseEstimate, child: str) -> None:
        """Add a pose to the path of its source, and now and then put the path."""
        publisher = self._publisher("path", event.source)
        if publisher is None:
            return
        config, frame = self._config, self._names.name(event.frame_id, event.source)
        path, due = self._paths.get(event.source, (None, event.stamp))
        if path is None or path.frame != frame:
            path = Path(self._store, frame, config.path_step, config.path_length)
            self._paths[event.source] = (path, due)
        axes = self._names.axes(event.frame_id)
        position: Vector3 = convert_vector(axes, event.position)
        far = path.far(position)
        if not far and event.stamp < due:
            return
        child_axes = self._names.axes(child)
        rotation: Quaternion = convert_rotation(axes, child_axes, event.orientation)
        time = self._time(event.stamp)
        if far:
            path.add(time, position, rotation)
        if event.stamp >= due:
            publisher.put(path.message(time, position, rotation))
            self._paths[event.source] = (path, event.stamp + round(SECOND / config.path_rate))

    def _picture(
        self, what: What, event: Image | DepthImage | SegmentationImage, encoding: str
    ) -> None:
        publisher = self._publisher(what, event.source)
        if publisher is None:
            return
        frame = self._names.name(event.frame_id, event.source)
        writer = self._writers.get((what, event.source))
        if writer is None or (writer.encoding, writer.frame_id) != (encoding, frame):
            writer = ImageWriter(self._store, frame, encoding)
            self._writers[what, event.source] = writer
        publisher.put(writer.write(self._time(event.stamp), event.data))

    def _info(self, what: What, stamp: int, source: str) -> None:
        camera = self._cameras.get(source)
        publisher = self._publisher(what, source) if camera is not None else None
        if camera is not None and publisher is not None:
            frame = camera.frame_id
            publisher.put(self._messages.camera_info(self._time(stamp), camera.info, frame))

    def _tf(self, time: Time, transforms: Any) -> None:
        if transforms and (publisher := self._publisher("tf", "")):
            publisher.put(self._messages.transforms(time, transforms))

    def _put_static(self) -> None:
        transforms = self._transforms.static()
        if transforms and (publisher := self._publisher("tf_static", "")):
            publisher.put(self._messages.transforms(self._time(0), transforms))

    def _publisher(self, what: What, source: str) -> Publisher | None:
        """Return a publisher, declared now if nobody announced the source."""
        try:
            return self._publishers[what, source]
        except KeyError:
            found = publication(what, source, self._config)
            if found is None:
                self._publishers[what, source] = None
                return None
            return self._declare(found)

    def _declare(self, found: Publication) -> Publisher:
        with self._lock:  # lanes beside the loop may want one for the first time together
            key = (found.what, found.source)
            known = self._publishers.get(key)
            if known is None:
                hash_ = self._store.hash(found.type)
                topic = Topic(name=found.topic, type=found.type, hash=hash_, qos=found.qos)
                known = self._publishers[key] = self._session.publisher(topic)
            return known
