"""The bridge as a node: what it hears from the run and says to ROS 2, and the other way round."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Image,
    Imu,
    LaserScan3D,
    MagneticField,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Range,
    Score,
    SegmentationImage,
    Setpoint,
    TransformStamped,
)
from nodes.ros2_bridge.complaints import Complaints
from nodes.ros2_bridge.inbox import Inbox
from nodes.ros2_bridge.incoming_topic import Hearing
from nodes.ros2_bridge.keys import NodeName
from nodes.ros2_bridge.outgoing_topic import Telling, event_type
from nodes.ros2_bridge.publishing import Publishing
from nodes.ros2_bridge.session import Session, SessionError
from nodes.ros2_bridge.settings import Ros2BridgeConfig
from nodes.ros_messages.calibration import camera_announcement
from nodes.ros_messages.messages import Time
from nodes.ros_messages.stamps import Stamps
from nodes.ros_messages.typestore import TypeStore
from runtime import Node, Output, Stream, Tick, every, on
from runtime.errors import FatalError, UncheckableError
from runtime.ports import Handles

WAITING = 8
"""Pictures of one kind that wait to be published; the oldest is dropped, and counted."""


class Ros2Bridge(Node[Ros2BridgeConfig]):
    """ROS 2 sees the run as a node with ordinary topics, and the run hears topics of ROS 2.

    ::

        [[nodes]]
        name = "ros2"
        type = "nodes.ros2_bridge:Ros2Bridge"

        [[nodes.subscriptions]]
        topic = "/cmd_vel"
        type = "geometry_msgs/msg/Twist"
        as = "velocity"

    What is announced has its topics from the start; what is not, from its first event. What comes
    from outside and makes no sense is counted, logged now and then, and left out.
    """

    estimates = Output(PoseEstimate)
    setpoints = Output(Setpoint)
    pictures = Output(Image)
    depth_pictures = Output(DepthImage)
    inertial = Output(Imu)
    odometry = Output(Odometry)
    others = Output(Event)
    """What mappings of the user's own make."""

    def __init__(self) -> None:
        self._session: Session | None = None
        self._publishing: Publishing | None = None
        self._lanes: dict[type[Event], Stream[Any]] = {
            kind: Stream(f"{self.name}.{kind.__name__}", WAITING, "drop_oldest", soon=True)
            for kind in (Image, DepthImage, SegmentationImage, PointCloud, LaserScan3D)
        }
        self._hearings: list[Hearing] = []
        self._seen: list[Stream[bytes]] = []
        """Pictures from ROS that wait to be read."""
        self._tellings: list[tuple[Telling, Stream[Event]]] = []
        self._cameras: list[CameraAnnouncement] = []
        self._stamps: Stamps | None = None
        self._open = False
        if self.config.publications:
            self._hear_more()
        # What ROS sends comes at its own time.
        self.deterministic = not self.config.subscriptions  # type: ignore[misc]

    async def on_startup(self) -> None:
        """Join the network, and wait for the cameras that ROS has.

        Raises:
            MissingDependencyError: rosbags is not installed.
            FatalError: The settings make no sense together, or there is no session to be had.
        """
        config = self.config
        if config.time == "wall" and self.clock.kind != "real":
            self.log.fatal('time = "wall" needs clock = "real", found "%s"', self.clock.kind)
        if config.subscriptions and self.clock.kind != "real":
            self.log.warning(
                "what ROS sends comes at its own time, so runs in lockstep will differ; "
                'subscriptions are for clock = "real"'
            )
        self._complaints = Complaints(self.log.warning)
        try:
            self._store = await self.offload(TypeStore, config.distribution, config.definitions)
            self._hearings = [
                Hearing(each, config, self._store, self.name, self._complaints)
                for each in config.subscriptions
            ]
            self._tellings = [
                (
                    Telling(each, config, self._store, self._complaints),
                    Stream(f"{self.name}.{each.topic}", each.depth, "drop_oldest", soon=True),
                )
                for each in config.publications
            ]
            if self.checking:
                if any(hearing.subscription.use == "camera" for hearing in self._hearings):
                    raise UncheckableError("which cameras there are is known to ROS only")
                return
            session = await self.offload(
                Session,
                NodeName(
                    name=config.node_name, namespace=config.namespace, domain_id=config.domain_id
                ),
                keys=config.keys,
                connect=config.connect,
                listen=config.listen,
                file=config.zenoh_config,
            )
        except (ValueError, SessionError) as error:
            self.log.fatal("%s", error)
        self._session = session
        self._publishing = Publishing(session, self._store, config, self._time)
        await self.offload(self._publishing.warm_up)
        for telling, _ in self._tellings:
            self._publishing.declare(telling)
        try:
            for hearing in self._hearings:
                if hearing.subscription.use == "camera":
                    await self._find_camera(session, hearing)
        except FatalError:
            await self.offload(session.close)
            raise
        except asyncio.CancelledError:
            session.give_up()
            raise

    def announce(self) -> Iterable[Announcement]:
        """Say which estimates and cameras will come from ROS."""
        yield from self._cameras
        for hearing in self._hearings:
            said = hearing.subscription
            if said.use == "estimate":
                yield EstimatorAnnouncement(
                    stamp=0,
                    source=hearing.source,
                    method=f"ROS 2: {hearing.topic.name}",
                    scale_free=said.scale_free,
                )

    def on_announcement(self, announcement: Announcement) -> None:
        """Declare the publishers for what will be said."""
        ours = {hearing.source for hearing in self._hearings}
        if self._publishing is not None and announcement.source not in ours:
            self._publishing.announced(announcement)

    async def run(self) -> None:
        """Subscribe, and publish pictures and clouds beside the loop, each kind in order."""
        publishing, session = self._publishing, self._session
        assert publishing is not None
        assert session is not None
        self._open = True
        self._told()
        publishing.begin()
        for line in publishing.unannounced():
            self.log.warning("%s", line)
        for kind, events in self._lanes.items():
            self.start(self._lane(events, publishing.large[kind]))
        for telling, waiting in self._tellings:
            self.start(self._lane(waiting, functools.partial(publishing.own, telling)))
        for hearing in self._hearings:
            await self.offload(session.subscribe, hearing.topic, self._inbox(hearing).take)

    async def on_shutdown(self) -> None:
        """Leave the network, and tell what went where."""
        self._open = False
        publishing, session = self._publishing, self._session
        if publishing is None or session is None:
            return
        sent = [each for each in publishing.publishers if each.sent]
        heard = sum(hearing.heard for hearing in self._hearings)
        refused = sum(self._complaints.counts.values()) + sum(lane.dropped for lane in self._seen)
        self.log.info(
            "%d messages published on %d topics (%d pictures, %d others dropped); %d heard, "
            "%d refused or dropped",
            sum(each.sent for each in sent),
            len(sent),
            sum(lane.dropped for lane in self._lanes.values()),
            sum(waiting.dropped for _, waiting in self._tellings),
            heard,
            refused,
        )
        for line in publishing.unused():
            self.log.warning("%s", line)
        if not await self.offload(session.close):
            self.log.warning("a peer that stands still keeps the session from closing")

    @on(Image, DepthImage, SegmentationImage, PointCloud, LaserScan3D)
    def shown(self, event: Event) -> None:
        """Have a picture or a cloud published beside the loop."""
        self._lanes[next(kind for kind in self._lanes if isinstance(event, kind))].offer(event)

    @on(
        *(Odometry, PoseStamped, PoseEstimate, TransformStamped, Score),
        *(Imu, Range, FluidPressure, MagneticField, NavSatFix),
    )
    def said(self, event: Event) -> None:
        """Publish what is small, at once."""
        if self._publishing is not None:
            self._publishing.small(event)

    def tell(self, event: Event) -> None:
        """Have a mapping of the user's own make a message of an event, beside the loop."""
        for telling, waiting in self._tellings:
            if telling.wants(event):
                waiting.offer(event)

    @every(hz="clock_rate")
    def tell_time(self, tick: Tick) -> None:  # noqa: ARG002
        """Publish ``/clock``."""
        if self._publishing is not None:
            self._publishing.clock(self.clock.now())

    def _hear_more(self) -> None:
        """Have `tell` called with the events that the file's publications are of.

        Raises:
            FatalError: One is of no type of event.
        """
        try:
            events = tuple({event_type(each) for each in self.config.publications})
        except ValueError as error:
            self.log.fatal("%s", error)
        declared = self.declared
        # Which events these are is this node's own matter, and not its class's.
        self.declared = msgspec.structs.replace(  # type: ignore[misc]
            declared,
            handlers={**declared.handlers, "tell": Handles(events, None)},
            listening=[*declared.listening, "tell"],
        )

    async def _lane(self, events: Stream[Any], put: Callable[[Any], None]) -> None:
        async for event in events:
            await self.offload(put, event)

    async def _look(self, hearing: Hearing, waiting: Stream[bytes]) -> None:
        """Read pictures beside the loop."""
        async for data in waiting:
            event = await self.offload(hearing.event, data, self.clock.now(), self._told())
            if event is not None:
                self._send(event)

    def _inbox(self, hearing: Hearing) -> Inbox:
        said = hearing.subscription

        def deliver(data: bytes) -> None:
            if self._open:
                event = hearing.event(data, self.clock.now(), self._told())
                if event is not None:
                    self._send(event)

        take: Callable[[bytes], object] = deliver
        if said.use in {"image", "depth"}:
            name = f"{self.name}.{hearing.topic.name}"
            waiting = Stream[bytes](name, said.depth, "drop_oldest", soon=True)
            self._seen.append(waiting)
            self.start(self._look(hearing, waiting))
            take = waiting.offer
        return Inbox(
            asyncio.get_running_loop(),
            take,
            depth=said.depth,
            rate=said.rate,
            largest=self.config.largest,
            complain=hearing.complain,
        )

    def _send(self, event: Event) -> None:
        match event:
            case PoseEstimate():
                self.estimates.send(event)
            case Setpoint():
                self.setpoints.send(event)
            case Image():
                self.pictures.send(event)
            case DepthImage():
                self.depth_pictures.send(event)
            case Imu():
                self.inertial.send(event)
            case Odometry():
                self.odometry.send(event)
            case _:
                self.others.send(event)

    async def _find_camera(self, session: Session, hearing: Hearing) -> None:
        """Wait for a camera's calibration, and remember to announce it."""
        wait, topic = hearing.subscription.wait, hearing.topic
        images, frame_id = self._images_of(hearing.source), hearing.subscription.frame_id

        def read(size: int, data: Callable[[], bytes]) -> CameraAnnouncement | None:
            try:
                if size > self.config.largest:
                    raise ValueError(f"expected {self.config.largest} bytes or less, found {size}")
                message = self._store.deserialize(data(), topic.type)
                return camera_announcement(message, hearing.source, images, frame_id)
            except ValueError as error:
                hearing.complain("calibration refused", str(error))
                return None

        found = await self.offload(session.first, topic, wait, read)
        if found is None:
            self.log.fatal("%s: expected a calibration within %g s, found none", topic.name, wait)
        self._cameras.append(found)

    def _images_of(self, source: str) -> tuple[str, ...]:
        kinds = {"image": "rgb", "depth": "depth"}
        uses = [each.subscription.use for each in self._hearings if each.source == source]
        return tuple(kinds[use] for use in uses if use in kinds)

    def _told(self) -> Stamps:
        """Return how messages tell the time, which is fixed when the first is made."""
        if self._stamps is None:
            wall = self.config.time == "wall"
            self._stamps = Stamps(time.time_ns() - self.clock.now() if wall else 0)
        return self._stamps

    def _time(self, stamp: int) -> Time:
        return self._told().out(stamp)
