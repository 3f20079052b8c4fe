"""Topics by settings of the user's: from messages to events, and by mappings of their own back.

Faults of messages are counted. Messages pass bounded from the reading threads to the loop, with one
wake-up for a burst: too fast ones are dropped before their bytes are copied, and the loop is given
back after `BUDGET`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from events import Announcement, CameraAnnouncement, EstimatorAnnouncement, Event, PilotAnnouncement
from nodes.ros2.bridge.keys import Complaints, Message
from nodes.ros2.bridge.session import Publisher, Session
from nodes.ros2.bridge.settings import (
    OwnPublication,
    Ros2BridgeConfig,
    Subscription,
    event_type,
    import_mapping,
)
from nodes.ros2.messages.incoming import MessageContext, camera_announcement
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.topics import Qos, Topic, ros_name, topic_name
from nodes.ros2.messages.typestore import MessageBuilder, MessageError, Stamps, TypeStore
from runtime import Stream


class IncomingTopic:
    """Reader of a subscription's messages as events; a `ValueError` if its type is unknown."""

    def __init__(
        self,
        subscription: Subscription,
        config: Ros2BridgeConfig,
        store: TypeStore,
        node: str,
        complaints: Complaints,
    ) -> None:
        self.subscription = subscription
        name = topic_name(config.namespace, subscription.topic)
        self.topic = topic(store, name, subscription.type, subscription.qos)
        self.source = subscription.source or f"{node}/{ros_name(subscription.topic)}"
        self.received = 0
        self._store, self._complaints = store, complaints
        if subscription.use:
            self._read = READERS[subscription.type, subscription.use].read
        else:
            self._read = import_mapping(subscription.topic, subscription.mapping)

    def complain(self, kind: str, detail: str) -> None:
        """Count, and now and then log, something wrong with this topic."""
        self._complaints.add(self.topic.name, kind, detail)

    def announce(self) -> Iterator[Announcement]:
        """Announce the estimator or the pilot whose messages these are; else their source."""
        subscription = self.subscription
        if subscription.source:
            yield Announcement(stamp=0, source=self.source)
        if subscription.use in {"velocity", "position", "pose"}:
            yield PilotAnnouncement(stamp=0, source=self.source, vehicle=subscription.vehicle)
        if subscription.use == "estimate":
            method, scale_free = f"ROS 2: {self.topic.name}", subscription.scale_free
            cameras = (subscription.answers_to,) if subscription.answers_to else ()
            yield EstimatorAnnouncement(
                stamp=0,
                source=self.source,
                method=method,
                scale_free=scale_free,
                cameras=cameras,
            )

    def find_camera(
        self, session: Session, images: tuple[str, ...], max_size: int
    ) -> concurrent.futures.Future[CameraAnnouncement]:
        """Subscribe to the calibration of a camera with these images; return the first, if any."""
        pending: concurrent.futures.Future[CameraAnnouncement] = concurrent.futures.Future()

        def receive(message: Message) -> None:
            if pending.done():
                return
            try:
                if message.size > max_size:
                    raise ValueError(f"expected {max_size} bytes or less, found {message.size}")
                info = self._store.deserialize(message.read(), self.topic.type)
                frame_id = self.subscription.frame_id
                camera = camera_announcement(info, self.source, images, frame_id)
            except ValueError as error:
                self.complain("calibration refused", str(error))
            else:
                with contextlib.suppress(concurrent.futures.InvalidStateError):
                    pending.set_result(camera)

        session.subscribe(self.topic, receive, late=True)
        return pending

    def event(self, data: bytes, now: int, stamps: Stamps) -> Event | None:
        """Return the event of a message; `None` if refused or of no use."""
        message = self._message(data)
        return None if message is None else self._event(message, now, stamps)

    def answer(self, data: bytes, stamps: Stamps) -> tuple[int, Event | None] | None:
        """Return the answered image's stamp (ns), and the event or `None`. In any thread."""
        message = self._message(data)
        if message is None:
            return None
        header = getattr(message, "header", message)
        time = getattr(header, "stamp", header)
        stamp = stamps.stamp(time.sec, time.nanosec)
        return stamp, self._event(message, stamp, stamps)

    def _message(self, data: bytes) -> Any:
        try:
            return self._store.deserialize(data, self.topic.type)
        except MessageError as error:
            self.complain(f"not a {self.topic.type}", str(error))
            return None

    def _event(self, message: Any, now: int, stamps: Stamps) -> Event | None:
        context = MessageContext(
            source=self.source,
            now=now,
            stamps=stamps,
            frame_id=self.subscription.frame_id,
            vehicle=self.subscription.vehicle,
        )
        try:
            event = self._read(message, context)
        except (ValueError, TypeError, ArithmeticError) as error:
            self.complain("message refused", str(error))
            return None
        except Exception as error:  # a mapping is the user's own
            self.complain("mapping failed", f"{type(error).__name__}: {error}")
            return None
        if event is None:
            return None
        if not isinstance(event, Event):
            self.complain("mapping failed", f"expected an event, found {type(event).__name__}")
            return None
        self.received += 1
        return event


def topic(store: TypeStore, name: str, type_: str, qos: Qos) -> Topic:
    """Return a topic with the hash of its type; a `ValueError` if the type is unknown."""
    try:
        return Topic(name=name, type=type_, hash=store.hash(type_), qos=qos)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


BUDGET = 0.0005  # longest turn of the loop, seconds


class Inbox:
    """Unread messages of a topic.

    Args:
        deliver: Called on the loop with the bytes of each; must not raise.
        complain: Called in the reading thread with the reason of a drop.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        deliver: Callable[[bytes], object],
        *,
        depth: int,  # messages that wait at most; the oldest is dropped
        max_rate: float,  # messages a second at most, with bursts of `depth`
        max_size: int,  # bytes of a message at most
        complain: Callable[[str, str], None],
        now: Callable[[], float] = time.monotonic,  # real seconds
    ) -> None:
        self._loop, self._deliver, self._depth, self._max_rate = loop, deliver, depth, max_rate
        self._max_size, self._complain, self._now = max_size, complain, now
        self._waiting: deque[bytes] = deque()
        self._lock = threading.Lock()
        self._allowed, self._checked_at = float(depth), now()
        self._woken = False
        self.wake_ups = 0

    def receive(self, message: Message) -> None:
        """Store a message, in any thread; never waits."""
        if message.size > self._max_size:
            fault = f"expected {self._max_size} bytes or less, found {message.size}"
            self._complain("message too large", fault)
            return
        if not self._within_rate():
            self._complain("too many messages", f"expected {self._max_rate:g} a second or less")
            return
        data = message.read()
        with self._lock:
            full = len(self._waiting) == self._depth
            if full:
                self._waiting.popleft()
            self._waiting.append(data)
            wake, self._woken = not self._woken, True
        if full:
            self._complain("more messages than wait here", f"the oldest of {self._depth} dropped")
        if wake:
            with contextlib.suppress(RuntimeError):  # the loop has been closed
                self._loop.call_soon_threadsafe(self._drain)

    def _within_rate(self) -> bool:
        """Return whether another message is allowed: `max_rate` more each second."""
        with self._lock:
            now = self._now()
            more = (now - self._checked_at) * self._max_rate
            self._allowed, self._checked_at = min(self._allowed + more, float(self._depth)), now
            if self._allowed < 1.0:
                return False
            self._allowed -= 1.0
            return True

    def _drain(self) -> None:
        self.wake_ups += 1
        end = time.perf_counter() + BUDGET
        while True:
            with self._lock:
                if not self._waiting:
                    self._woken = False
                    return
                data = self._waiting.popleft()
            self._deliver(data)
            if time.perf_counter() > end:
                self._loop.call_soon(self._drain)
                return


class OutgoingTopic:
    """Writer of a publication's messages; a `ValueError` if type, event or mapping is unknown."""

    def __init__(
        self,
        publication: OwnPublication,
        config: Ros2BridgeConfig,
        store: TypeStore,
        complaints: Complaints,
    ) -> None:
        self.publication = publication
        self.waiting = Stream[Event](publication.topic, publication.depth, "drop_oldest", soon=True)
        self.publisher: Publisher | None = None
        name = topic_name(config.namespace, publication.topic)
        self.topic = topic(store, name, publication.type, publication.qos)
        self._store, self._complaints = store, complaints
        self.event = event_type(publication)
        self._map = import_mapping(publication.topic, publication.mapping)

    def accepts(self, event: Event) -> bool:
        """Return whether an event becomes a message."""
        source = self.publication.source
        return isinstance(event, self.event) and (
            not source or event.source == source or event.source.startswith(f"{source}/")
        )

    def put(self, builder: MessageBuilder, event: Event) -> None:
        """Publish the message of an event, if any."""
        if self.publisher is not None and (message := self.message(event, builder)) is not None:
            self.publisher.put(message)

    def message(self, event: Event, builder: MessageBuilder) -> bytearray | None:
        """Return the message of an event; `None` if there is none, or none can be made."""
        try:
            message = self._map(event, builder)
            if message is None:
                return None
            type_ = getattr(message, "__msgtype__", type(message).__name__)
            if type_ != self.topic.type:
                raise TypeError(f"expected a {self.topic.type}, found {type_}")
            return self._store.serialize(message)
        except Exception as error:  # a mapping is the user's own
            detail = f"{type(error).__name__}: {error}"
            self._complaints.add(self.topic.name, "mapping failed", detail)
            return None
