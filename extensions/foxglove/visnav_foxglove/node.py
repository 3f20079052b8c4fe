"""Foxglove server as a node, and its messages, in ROS's axes: ROS's as CDR, Foxglove's own.

Images and point clouds are put from threads beside the loop, one of each kind at a time; the rest
takes microseconds and is put at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import msgspec

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    LidarScan,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PositionSetpoint,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TransformStamped,
    Vector3,
    VehicleAnnouncement,
    VehicleEvent,
)
from events.frames import convert_vector
from events.geometry import Pose
from nodes.ros2.messages import mappings
from nodes.ros2.messages.mappings import PUBLISHED
from nodes.ros2.messages.mappings import Publishing as RosPublishing
from nodes.ros2.messages.topics import ALL_GROUPS, PublishingConfig, Topic, ros_name
from nodes.ros2.messages.typestore import Stamps, TypeStore
from nodes.trajectory import RecentPoses
from nodes.viewers.common import (
    INLIER,
    OUTLIER,
    PLAN,
    VEHICLE,
    Box,
    Colour,
    ImageSelection,
    PlanSelection,
    Trail,
    describe,
    estimate_colour,
    estimate_frame,
    moving_body,
    truth_colour,
)
from runtime import Node, Stream, Tick, every, on
from runtime.errors import MissingDependencyError, VisnavError
from runtime.time.clock import SECOND
from visnav_foxglove.server import FoxgloveConfig, Server


class Messages:
    """Maker of messages of ``foxglove.messages``."""

    def __init__(self, types: Any) -> None:
        self._m = types

    def features(self, event: TrackedFeatures) -> Any:
        """Return an ImageAnnotations: inliers in green, the rest in red."""
        groups = [
            self._m.PointsAnnotation(
                timestamp=self._time(event.stamp),
                type=self._m.PointsAnnotationType.Points,
                points=[self._m.Point2(x=x, y=y) for x, y in event.points[chosen].tolist()],
                outline_color=self._colour(colour),
                fill_color=self._colour(colour),
                thickness=4.0,
            )
            for chosen, colour in ((event.inliers, INLIER), (~event.inliers, OUTLIER))
        ]
        return self._m.ImageAnnotations(points=groups)

    def log(self, event: Event) -> Any:
        """Return a Log."""
        levels = self._m.LogLevel
        return self._m.Log(
            timestamp=self._time(event.stamp),
            level=levels.Warning if isinstance(event, TrackingLost) else levels.Info,
            message=describe(event),
            name=event.source,
        )

    def scene(self, *entities: Any) -> Any:
        """Return a SceneUpdate of entities from `line` and `body`."""
        return self._m.SceneUpdate(entities=list(entities))

    def line(self, trail: Trail, name: str, piece: list[Vector3]) -> Any:
        """Return a piece of a path as a SceneEntity."""
        strip = self._m.LinePrimitive(
            type=self._m.LinePrimitiveLineType.LineStrip,
            thickness=trail.thickness,
            points=[self._m.Point3(x=x, y=y, z=z) for x, y, z in piece],
            color=self._colour(trail.colour),
        )
        return self._m.SceneEntity(frame_id=trail.frame_id, id=name, lines=[strip])

    def body(self, name: str, frame_id: str, boxes: Sequence[Box] = VEHICLE) -> Any:
        """Return a body as a SceneEntity fixed to its frame; by default a vehicle's."""
        vector = self._m.Vector3
        cubes = []
        for centre, (length, width, height), colour in boxes:
            x, y, z = convert_vector("body", centre)
            cubes.append(
                self._m.CubePrimitive(
                    pose=self._m.Pose(
                        position=vector(x=x, y=y, z=z), orientation=self._m.Quaternion(w=1.0)
                    ),
                    size=vector(x=length, y=width, z=height),
                    color=self._colour(colour),
                )
            )
        return self._m.SceneEntity(frame_id=frame_id, id=name, frame_locked=True, cubes=cubes)

    def _colour(self, colour: Colour) -> Any:
        r, g, b = colour
        return self._m.Color(r=r / 255, g=g / 255, b=b / 255, a=1.0)

    def _time(self, stamp: int) -> Any:
        return self._m.Timestamp(sec=stamp // SECOND, nsec=stamp % SECOND)


E = TypeVar("E", bound=Event)


class RosTopics:
    """The topics of ROS's messages."""

    def __init__(self, server: Server, store: TypeStore) -> None:
        self.server = server
        self._definitions = {row.type: store.definition(row.type) for row in PUBLISHED}
        self._stamps = threading.local()  # of what each thread puts

    def publisher(self, topic: Topic) -> RosTopic:
        """Declare a topic."""
        self.server.declare_ros(topic.name, topic.type, self._definitions[topic.type])
        return RosTopic(self, topic)

    def stamped(self, publish: Callable[[E], None]) -> Callable[[E], None]:
        """Return `publish`, whose messages then have the time of their event."""

        def publish_stamped(event: E) -> None:
            self._stamps.stamp = event.stamp
            publish(event)

        return publish_stamped

    @property
    def stamp(self) -> int:
        """Return the stamp of the event whose messages this thread puts (ns)."""
        return getattr(self._stamps, "stamp", 0)


class RosTopic:
    """A topic of ROS messages; late viewers get the newest of a transient-local topic or a map."""

    def __init__(self, topics: RosTopics, topic: Topic) -> None:
        self.topic, self._topics = topic, topics
        cloud = topic.type == "sensor_msgs/msg/PointCloud2"
        self._is_latched = topic.qos.transient_local or (cloud and topic.qos.reliable)

    @property
    def wanted(self) -> bool:
        """Return whether the topic has a viewer, or stores messages for later viewers."""
        return self._is_latched or self._topics.server.wanted(self.topic.name)

    def put(self, message: bytearray) -> None:
        """Send a message to the topic's viewers."""
        data, server, stamp = bytes(message), self._topics.server, self._topics.stamp
        if self._is_latched:
            server.latch(self.topic.name, lambda: data, stamp)
        else:
            server.log(self.topic.name, data, stamp)


SMALL: tuple[type[Event], ...] = (
    *(kind for kind in mappings.SMALL if kind is not TrackedFeatures),
    *(PlannedPose, PositionSetpoint, TrackingEvent, VehicleEvent),
)  # events whose messages are made at once

_LEFT_OUT = {"clock", "paths", "camera_poses", "body_poses", "segmentation_images"}
"""Groups of ROS topics left out: shown in another way, or not at all by Foxglove."""


class Publishing:
    """Converter of events to messages. Takes tenths of a second to create: not on the loop."""

    def __init__(self, server: Server, config: FoxgloveConfig) -> None:
        self._server = server
        self._make = Messages(server.types)
        left_out = _LEFT_OUT | ({"depth_images"} if not config.depth else set())
        if not config.image_rate:
            left_out |= {"images", "depth_images"}
        published = PublishingConfig(
            publish=tuple(group for group in ALL_GROUPS if group not in left_out),
            raw_images=not config.jpeg_quality,
            compressed_images="jpeg" if config.jpeg_quality else "",
            jpeg_quality=config.jpeg_quality,
            raw_depth="millimetres",
        )
        store = TypeStore()
        topics = RosTopics(server, store)
        self._ros: RosPublishing[RosTopic]
        self._ros = RosPublishing(topics, store, published, Stamps().out)
        self._ros.warm_up()
        self._publish_ros = topics.stamped(self._ros.put)
        self._names = self._ros.names
        self._frames: dict[str, str] = {}  # sources of images, by optical frame
        self._estimators: dict[str, str] = {}  # parent frames, by source
        self._renamed: dict[str, str] = {}  # the same by what the estimators call them
        self._truths: dict[str, RecentPoses] = {}  # by vehicle
        self._trails: dict[str, Trail] = {}
        self._bodies: dict[str, Callable[[], Any]] = {}
        """Makers of the bodies' entities, by source: frame names depend on the other vehicles."""
        self._plan = PlanSelection()
        server.declare("/scene", "SceneUpdate")
        server.declare("/log", "Log")

    def announced(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        source = announcement.source
        self._ros.announced(announcement)
        match announcement:
            case VehicleAnnouncement():
                self._vehicle(source, "base_link")
            case CameraAnnouncement():
                self._frames.setdefault(announcement.frame_id, source)
            case BodyAnnouncement(kind=kind):
                self._bodies[source] = lambda: self._make.body(
                    source, ros_name(source), [moving_body(kind)]
                )

    def begin(self) -> None:
        """Publish the messages that are valid for the whole run."""
        self._ros.begin()
        self._server.latch("/scene", self._whole_scene, 0)

    def features(self, event: TrackedFeatures) -> None:
        """Publish an estimator's tracked features of an image; beside the loop."""
        if (camera := self._frames.get(event.frame_id)) is not None:
            topic = f"/{ros_name(camera)}/features/{ros_name(event.source)}"
            self._server.declare(topic, "ImageAnnotations")
            if self._server.wanted(topic):
                self._server.log(topic, self._make.features(event), event.stamp)

    def put(self, event: Event) -> None:
        """Publish an event: images and clouds beside the loop, others on the loop."""
        match event:
            case PointCloud():  # in the frame of an estimator if it is that
                frame = self._renamed.get(event.frame_id, event.frame_id)
                self._publish_ros(msgspec.structs.replace(event, frame_id=frame))
            case Odometry():
                self._odometry(event)
            case PoseEstimate():
                self._estimate(event)
            case PlannedPose() | PositionSetpoint():
                if self._plan.select(event):
                    name = f"plan/{event.vehicle}" if event.vehicle else "plan"
                    self._extend(name, "map", PLAN, event)
            case TrackingEvent() | VehicleEvent():
                self._server.log("/log", self._make.log(event), event.stamp)
            case _:
                self._publish_ros(event)

    def _odometry(self, event: Odometry) -> None:
        source = event.source
        self._vehicle(source, event.child_frame_id)
        self._publish_ros(event)
        self._truths[source].add(event.stamp, event.position, event.orientation)
        colour = truth_colour(list(self._truths).index(source))
        self._extend(f"truth/{source}", event.frame_id, colour, event)

    def _estimate(self, event: PoseEstimate) -> None:
        """Publish an estimate (aligned unless in ``map``) and its transform."""
        source, body = event.source, f"{event.source}/{event.child_frame_id}"
        parent = self._estimators.get(source)
        if parent is None:
            parent = self._estimators[source] = self._parent_frame(event)
            self._names.own.add(body)
        self._publish_ros(msgspec.structs.replace(event, frame_id=parent))
        self._place(event, parent, body, (event.position, event.orientation))
        colour = estimate_colour(list(self._estimators).index(source))
        self._extend(f"estimate/{source}", parent, colour, event)

    def _vehicle(self, source: str, frame_id: str) -> None:
        if source not in self._truths:
            self._truths[source] = RecentPoses()
            self._bodies[source] = lambda: self._make.body(
                source, self._names.name(frame_id, source)
            )

    def _parent_frame(self, event: PoseEstimate) -> str:
        """Return an estimator's parent frame; its own frame is first aligned with the truth."""
        if event.frame_id == "map":
            return "map"
        frame_id = f"{event.source}/{event.frame_id}"
        self._names.own.add(frame_id)
        self._renamed.setdefault(event.frame_id, frame_id)
        truth = self._truths.get(self._names.vehicles.of(event.source))
        if (pose := estimate_frame(event, truth)) is not None:
            self._place(event, "map", frame_id, pose, static=True)
        return frame_id

    def _place(
        self, event: Event, parent: str, child: str, pose: Pose, *, static: bool = False
    ) -> None:
        self._publish_ros(
            TransformStamped(
                stamp=event.stamp,
                source=event.source,
                frame_id=parent,
                child_frame_id=child,
                translation=pose[0],
                rotation=pose[1],
                static=static,
            )
        )

    def _extend(
        self,
        name: str,
        frame_id: str,
        colour: Colour,
        event: Odometry | PoseEstimate | PlannedPose | PositionSetpoint,
    ) -> None:
        trail = self._trails.get(name)
        if trail is None:
            thickness = 0.04 if name.startswith("truth") else 0.02
            frame = self._names.name(frame_id, event.source)
            trail = self._trails[name] = Trail(name, frame, colour, thickness)
        position = convert_vector(self._names.axes(frame_id), event.position)
        piece = trail.add(event.stamp, position)
        if piece is not None and self._server.wanted("/scene"):
            line = self._make.line(trail, *piece)
            self._server.log("/scene", self._make.scene(line), event.stamp)

    def _whole_scene(self) -> Any:
        bodies = [make() for make in list(self._bodies.values())]
        lines = [
            self._make.line(trail, name, piece)
            for trail in list(self._trails.values())
            for name, piece in trail.pieces()
        ]
        return self._make.scene(*bodies, *lines)


_QUEUED = (Image, DepthImage, PointCloud, LidarScan, TrackedFeatures)
"""Events whose messages take long to make."""
WAITING = 8  # images of a kind waiting to be passed on; the oldest is dropped, and counted
_REFUSALS = 10  # different refusals to log, at most


class FoxgloveServer(Node[FoxgloveConfig]):
    """Live view of a run in Foxglove: *Open connection*, ``ws://localhost:8765``.

    ::

        [[nodes]]
        name = "foxglove"
        type = "FoxgloveServer"

    Topics, types and frames are ROS 2's, as of the bridge and a recording; paths, bodies, features
    and the log are Foxglove's own. Announced sources have topics from the start, others from their
    first event. Late viewers get fixed transforms, clouds and paths.
    """

    reads_truth = "showing"

    def __init__(self) -> None:
        self._server: Server | None = None
        self._publishing: Publishing | None = None
        self._selection = ImageSelection(self.config.image_rate)
        self._queues: dict[type[Event], Stream[Any]] = {
            kind: Stream(f"{self.name}.{kind.__name__}", WAITING, "drop_oldest", soon=True)
            for kind in _QUEUED
        }

    async def on_startup(self) -> None:
        """Begin to listen; a `FatalError` if the port is taken."""
        if self.checking:
            return
        loop, logged = asyncio.get_running_loop(), set[str]()

        def refused(reason: str) -> None:
            if reason not in logged and len(logged) < _REFUSALS:
                logged.add(reason)
                with contextlib.suppress(RuntimeError):  # the run is over
                    loop.call_soon_threadsafe(self.log.warning, "somebody was refused: %s", reason)

        try:
            server = await self.offload(Server, self.config, f"visnav: {self.name}", refused)
        except MissingDependencyError:
            raise
        except VisnavError as error:
            self.log.fatal("%s", error)
        self._server = server
        self._publishing = await self.offload(Publishing, server, self.config)
        self.log.info("open %s in Foxglove", server.address)

    def on_announcement(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        if self._publishing is not None:
            self._publishing.announced(announcement)

    async def run(self) -> None:
        """Pass on images and point clouds beside the loop, each kind in order."""
        publishing = self._publishing
        assert publishing is not None
        publishing.begin()
        for kind, events in self._queues.items():
            publish = publishing.features if kind is TrackedFeatures else publishing.put
            self.start(self._pass_on(events, publish))

    async def on_shutdown(self) -> None:
        """Stop listening."""
        if self._server is not None:
            await self.offload(self._server.close)
        if dropped := sum(queue.dropped for queue in self._queues.values()):
            self.log.warning("%d images dropped: they came faster than they could go", dropped)

    @on(Image, DepthImage)
    def images(self, event: Image | DepthImage) -> None:
        """Pass on some images, beside the loop."""
        kind = Image if isinstance(event, Image) else DepthImage
        if kind is DepthImage and not self.config.depth:
            return
        if self._selection.select(kind.__name__, event.source, event.frame_id, event.stamp):
            self._queues[kind].offer(event)

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Pass on the features of those images."""
        if self._publishing is not None:
            self._publishing.put(event)
        if self._selection.selected(event.frame_id, event.stamp):
            self._queues[TrackedFeatures].offer(event)

    @on(PointCloud, LidarScan)
    def point_clouds(self, event: PointCloud | LidarScan) -> None:
        """Pass on a point cloud, or a turn of a lidar."""
        self._queues[LidarScan if isinstance(event, LidarScan) else PointCloud].offer(event)

    @on(*SMALL)
    def measurements(self, event: Event) -> None:
        """Pass on small events at once."""
        if self._publishing is not None:
            self._publishing.put(event)

    @every(hz="clock_rate")
    def send_time(self, tick: Tick) -> None:  # noqa: ARG002
        """Send the run's time to viewers."""
        if self._server is not None:
            self._server.send_time(self.clock.now())

    async def _pass_on(self, events: Stream[Any], publish: Callable[[Any], None]) -> None:
        async for event in events:
            await self.offload(publish, event)
