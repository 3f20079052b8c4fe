"""The bridge as a node: events of the run become messages in ROS 2, and messages become events."""

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
    Command,
    Event,
    LidarAnnouncement,
    PoseEstimate,
    Setpoint,
    VehicleAnnouncement,
    VehicleEvent,
)
from nodes.ros2.bridge.held import HeldLine, held_estimators, why_no_answers
from nodes.ros2.bridge.incoming_topic import Inbox, IncomingTopic, OutgoingTopic
from nodes.ros2.bridge.keys import Complaints, NodeName
from nodes.ros2.bridge.services import Services
from nodes.ros2.bridge.session import Publisher, Session, SessionError
from nodes.ros2.bridge.settings import Ros2BridgeConfig, event_type
from nodes.ros2.messages.mappings import LARGE, READERS, RECEIVED, SMALL, Publishing
from nodes.ros2.messages.typestore import Stamps, TypeStore
from runtime import Node, Output, Stream, Tick, every, on
from runtime.channels.ports import Handles
from runtime.errors import FatalError, UncheckableError

WAITING = 8  # images of a kind waiting to be published; the oldest is dropped, and counted


class Ros2Bridge(Node[Ros2BridgeConfig]):
    """Bridge between a run, as a node of ROS 2 with ordinary topics, and topics of ROS 2 as events.

    ::

        [[nodes]]
        name = "ros2"
        type = "Ros2Bridge"

        [[nodes.subscriptions]]
        topic = "/cmd_vel"
        type = "geometry_msgs/msg/Twist"
        as = "velocity"

    Announced sources have topics from the start, others from their first event. Invalid messages
    are counted, logged now and then, and left out. An ``estimate`` that `answers_to` a camera is
    held: simulated time waits for the answer to each image. All of this node's topics are then
    reliable, complete and in one order, whatever `sensor_qos` says: a slow subscriber slows the run
    down.
    """

    reads_truth = "showing"
    ends_run = "hand"
    relays_estimates = True
    estimates = Output(PoseEstimate)
    setpoints = Output(Setpoint)
    # The estimates first: an event goes to the first output that takes it.
    locals().update({group: Output(event) for group, event in RECEIVED.items()})
    commands = Output(Command)
    mapped_events = Output(Event)
    """Events of the user's own mappings."""

    def __init__(self) -> None:
        self._session: Session | None = None
        self._publishing: Publishing[Publisher] | None = None
        self._queues: dict[type[Event], Stream[Any]] = {
            kind: Stream(f"{self.name}.{kind.__name__}", WAITING, "drop_oldest", soon=True)
            for kind in LARGE
        }
        self._incoming: list[IncomingTopic] = []
        self._unread: list[Stream[bytes]] = []  # unread images from ROS
        self._outgoing: list[OutgoingTopic] = []
        self._cameras: list[CameraAnnouncement] = []
        self._vehicles: list[str] = []
        self._services: Services | None = None
        self._stamps: Stamps | None = None
        self._open = False
        self._line: HeldLine | None = None  # publishes everything in order, if estimators are held
        self._rates: dict[str, float] = {}  # of announced cameras and lidars
        if self.config.publications:
            self._declare_mapped_events()
        # Messages of ROS come at their own time, unless time waits for them.
        self._unheld = [s.topic for s in self.config.subscriptions if not s.answers_to]
        steered = bool(self._unheld) or "vehicle" in self.config.services
        self.deterministic = not steered  # type: ignore[misc]

    async def on_startup(self) -> None:
        """Join the network, and wait for ROS's cameras; a `FatalError` if that fails."""
        config = self.config
        if config.time == "wall" and self.clock.kind != "real":
            self.log.fatal('time = "wall" needs clock = "real", found "%s"', self.clock.kind)
        if config.paused and (reason := self.stepping.fixed()):
            self.log.fatal("paused: %s", reason)
        if self._unheld and self.clock.kind != "real":
            self.log.warning(
                "messages of ROS on %s come at their own time, so runs in lockstep will differ; "
                'such subscriptions are for clock = "real"',
                ", ".join(self._unheld),
            )
        self._complaints = Complaints(self.log.warning)
        try:
            self._store = await self.offload(TypeStore, config.distribution, config.definitions)
            self._incoming = [
                IncomingTopic(subscription, config, self._store, self.name, self._complaints)
                for subscription in config.subscriptions
            ]
            self._outgoing = [
                OutgoingTopic(publication, config, self._store, self._complaints)
                for publication in config.publications
            ]
            if self.checking:
                if any(topic.subscription.use == "camera" for topic in self._incoming):
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
                max_wait=max((s.hold.max_wait for s in config.subscriptions), default=5.0),
            )
        except (ValueError, SessionError) as error:
            self.log.fatal("%s", error)
        self._session = session
        estimators = held_estimators(self, self._incoming, self._fix_time)
        if estimators:
            self._line = HeldLine(self, session, estimators, self._send)
        self._publishing = Publishing(
            self._line or session, self._store, config, lambda stamp: self._fix_time().out(stamp)
        )
        await self.offload(self._publishing.warm_up)
        try:
            for topic in self._incoming:
                if topic.subscription.use == "camera":
                    await self._find_camera(session, topic)
        except FatalError:
            await self.offload(session.close)
            raise

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimators, cameras and pilots in ROS."""
        yield from self._cameras
        for incoming in self._incoming:
            yield from incoming.announce()

    def on_announcement(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        own_sources = {incoming.source for incoming in self._incoming}
        if isinstance(announcement, CameraAnnouncement | LidarAnnouncement):
            self._rates[announcement.source] = announcement.rate
        if isinstance(announcement, VehicleAnnouncement):
            self._vehicles.append(announcement.source)
        if self._publishing is not None and announcement.source not in own_sources:
            self._publishing.announced(announcement)

    def check(self) -> Iterable[str]:
        """Return why an estimator could never answer."""
        return why_no_answers(self.config, self._rates, lockstep=self.clock.kind == "lockstep")

    async def run(self) -> None:
        """Subscribe, and publish images and point clouds beside the loop, each kind in order."""
        publishing, session = self._publishing, self._session
        assert publishing is not None
        assert session is not None
        self._open = True
        if self.config.paused:  # before any request can arrive
            self.stepping.pause()
        self._fix_time()
        if self._line is None:
            publishing.begin()
        for text in publishing.unannounced():
            self.log.warning("%s", text)
        for events in self._queues.values():
            self.start(self._publish_all(events, publishing.put))
        for outgoing in self._outgoing:
            outgoing.publisher = (self._line or session).publisher(outgoing.topic)
            publish = functools.partial(outgoing.put, publishing.builder)
            self.start(self._publish_all(outgoing.waiting, publish))
        for incoming in self._incoming:
            if not incoming.subscription.answers_to and incoming.subscription.use != "camera":
                await self.offload(session.subscribe, incoming.topic, self._inbox(incoming).receive)
        if self.config.services:
            self._services = Services(self._send, self, session, self._store, self._complaints)
            await self.offload(self._services.offer, self._vehicles)
        if self._line is not None:
            await self._line.begin(publishing.begin)

    async def on_shutdown(self) -> None:
        """Leave the network, and log how many messages were published and received."""
        self._open = False
        publishing, session = self._publishing, self._session
        if publishing is None or session is None:
            return
        if self._line is not None:
            await self._line.close()
        mapped = [o.publisher for o in self._outgoing if o.publisher is not None]
        sent = [p for p in publishing.publishers + mapped if p.sent]
        refused = sum(self._complaints.counts.values()) + sum(s.dropped for s in self._unread)
        self.log.info(
            "%d messages published on %d topics (%d images, %d others dropped); "
            "%d received, %d refused or dropped",
            sum(publisher.sent for publisher in sent),
            len(sent),
            sum(queue.dropped for queue in (*self._queues.values(), self._line) if queue),
            sum(outgoing.waiting.dropped for outgoing in self._outgoing),
            sum(incoming.received for incoming in self._incoming),
            refused,
        )
        for line in publishing.unused():
            self.log.warning("%s", line)
        if self._services is not None:
            await self._services.close()
        if not await self.offload(session.close):
            self.log.warning("a peer that stands still keeps the session from closing")

    @on(*LARGE)
    def images_and_clouds(self, event: Event) -> None:
        """Publish an image or a point cloud beside the loop."""
        if self._line is None:
            next(s for kind, s in self._queues.items() if isinstance(event, kind)).offer(event)
        elif self._publishing is not None:
            self._line.publish_image(event, self._publishing.put, self._publishing.clock)

    @on(*SMALL)
    def measurements(self, event: Event) -> None:
        """Publish small messages at once."""
        if self._publishing is not None:
            self._publish(self._publishing.put, event)

    @on(VehicleEvent)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Answer the requests whose action a vehicle has completed."""
        if self._services is not None:
            self._services.handle_event(event)

    def publications(self, event: Event) -> None:
        """Publish, beside the loop, the messages of the user's own mappings."""
        for outgoing in self._outgoing:
            if outgoing.accepts(event):
                if self._line is None or self._publishing is None:
                    outgoing.waiting.offer(event)
                else:
                    publish = functools.partial(outgoing.put, self._publishing.builder)
                    self._line.publish(publish, event)

    @every(hz="clock_rate")
    def publish_clock(self, tick: Tick) -> None:  # noqa: ARG002
        """Publish ``/clock``."""
        if self._publishing is not None:
            self._publish(self._publishing.clock, self.clock.now())

    def _declare_mapped_events(self) -> None:
        try:
            events = tuple({event_type(publication) for publication in self.config.publications})
        except ValueError as error:
            self.log.fatal("%s", error)
        declared = self.declared
        # Which events these are differs from node to node, so it is not declared in the class.
        self.declared = msgspec.structs.replace(  # type: ignore[misc]
            declared,
            handlers={**declared.handlers, "publications": Handles(events, None)},
            listening=[*declared.listening, "publications"],
        )

    def _publish(self, publish: Callable[[Any], None], value: Any) -> None:
        """Publish a small message, at once or in its turn."""
        if self._line is None:
            publish(value)
        else:
            self._line.publish(publish, value)

    async def _publish_all(self, events: Stream[Any], publish: Callable[[Any], None]) -> None:
        async for event in events:
            await self.offload(publish, event)

    async def _read_images(self, incoming: IncomingTopic, waiting: Stream[bytes]) -> None:
        async for data in waiting:
            event = await self.offload(incoming.event, data, self.clock.now(), self._fix_time())
            if event is not None:
                self._send(event)

    def _inbox(self, incoming: IncomingTopic) -> Inbox:
        subscription = incoming.subscription

        def deliver(data: bytes) -> None:
            if self._open:
                event = incoming.event(data, self.clock.now(), self._fix_time())
                if event is not None:
                    self._send(event)

        handler: Callable[[bytes], object] = deliver
        reader = READERS.get((subscription.type, subscription.use))
        if reader is not None and reader.large:
            name = f"{self.name}.{incoming.topic.name}"
            waiting = Stream[bytes](name, subscription.depth, "drop_oldest", soon=True)
            self._unread.append(waiting)
            self.start(self._read_images(incoming, waiting))
            handler = waiting.offer
        return Inbox(
            asyncio.get_running_loop(),
            handler,
            depth=subscription.depth,
            max_rate=subscription.max_rate,
            max_size=self.config.max_message_size,
            complain=incoming.complain,
        )

    def _send(self, event: Event) -> None:
        outputs = self.declared.outputs.items()
        port = next(port for port, output in outputs if isinstance(event, output.event))
        getattr(self, port).send(event)

    async def _find_camera(self, session: Session, incoming: IncomingTopic) -> None:
        timeout, max_size = incoming.subscription.timeout, self.config.max_message_size
        kinds = {"image": "rgb", "depth": "depth"}
        uses = [t.subscription.use for t in self._incoming if t.source == incoming.source]
        images = tuple(kinds[use] for use in uses if use in kinds)
        pending = await self.offload(incoming.find_camera, session, images, max_size)
        try:
            self._cameras.append(await self.offload(pending.result, timeout))
        except TimeoutError:
            self.log.fatal(
                "%s: expected a calibration within %g s, found none", incoming.topic.name, timeout
            )
        finally:
            pending.cancel()

    def _fix_time(self) -> Stamps:
        """Return the conversion of stamps to times of messages, fixed with the first message."""
        if self._stamps is None:
            wall = self.config.time == "wall"
            self._stamps = Stamps(time.time_ns() - self.clock.now() if wall else 0)
        return self._stamps
