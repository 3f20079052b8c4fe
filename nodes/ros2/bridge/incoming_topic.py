"""A topic that the bridge subscribes to: its messages to events, and all that may be wrong."""

from __future__ import annotations

import concurrent.futures
import contextlib
from collections.abc import Iterator
from typing import Any

from events import (
    Announcement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    Event,
    PilotAnnouncement,
)
from nodes.ros2.bridge.attachment import Message
from nodes.ros2.bridge.complaints import Complaints
from nodes.ros2.bridge.mappings import import_mapping
from nodes.ros2.bridge.session import Session
from nodes.ros2.bridge.settings import Ros2BridgeConfig, Subscription
from nodes.ros2.messages.calibration import camera_announcement
from nodes.ros2.messages.incoming import READERS, MessageContext, Reader
from nodes.ros2.messages.stamps import Stamps
from nodes.ros2.messages.topics import Qos, Topic, ros_name, topic_name
from nodes.ros2.messages.typestore import MessageError, TypeStore


class IncomingTopic:
    """Makes the events of one subscription.

    Args:
        subscription: As the file says.
        config: The bridge's settings.
        store: Of the types.
        node: The bridge's name, for the events' source.
        complaints: Notes what is wrong.

    Raises:
        ValueError: The type is not known, or the mapping cannot be imported.
    """

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
        self._store = store
        self._complaints = complaints
        self._read = _reader(subscription)

    def complain(self, kind: str, detail: str) -> None:
        """Count, and now and then log, something wrong with this topic."""
        self._complaints.add(self.topic.name, kind, detail)

    def announce(self) -> Iterator[Announcement]:
        """Announce the estimator or the pilot whose messages these are; else their source."""
        given = self.subscription
        if given.source:
            yield Announcement(stamp=0, source=self.source)
        if given.use in {"velocity", "position", "pose"}:
            yield PilotAnnouncement(stamp=0, source=self.source, vehicle=given.vehicle)
        if given.use == "estimate":
            method, scale_free = f"ROS 2: {self.topic.name}", given.scale_free
            yield EstimatorAnnouncement(
                stamp=0, source=self.source, method=method, scale_free=scale_free
            )

    def find_camera(
        self, session: Session, images: tuple[str, ...], max_size: int
    ) -> concurrent.futures.Future[CameraAnnouncement]:
        """Subscribe to the calibration of a camera with these images; return the first, if any."""
        found: concurrent.futures.Future[CameraAnnouncement] = concurrent.futures.Future()

        def take(message: Message) -> None:
            if found.done():
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
                    found.set_result(camera)

        session.subscribe(self.topic, take, late=True)
        return found

    def event(self, data: bytes, now: int, stamps: Stamps) -> Event | None:
        """Return what a message becomes; `None` if it is refused, or of no use."""
        message = self._message(data)
        return None if message is None else self._event(message, now, stamps)

    def answer(self, data: bytes, stamps: Stamps) -> tuple[int, Event | None] | None:
        """Return the stamp of the image that a message answers (ns), and what the message becomes.

        Its content may be refused, or of no use: `None`, and yet an answer. In any thread.
        """
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
    """Return a topic as the file has it.

    Raises:
        ValueError: The type is not known.
    """
    try:
        return Topic(name=name, type=type_, hash=store.hash(type_), qos=qos)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _reader(subscription: Subscription) -> Reader:
    if subscription.use:
        return READERS[subscription.type, subscription.use]
    return import_mapping(subscription.topic, subscription.mapping)
