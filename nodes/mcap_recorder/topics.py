"""Events to messages of a recording: those of ROS, as the bridge makes them, and the event itself.

A large array stands in the file once, in ROS's message; the event's own message then lacks it, has
the same time, and names that topic in its channel. Runs in the process that writes.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import struct
from collections.abc import Callable
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from events import Announcement, CameraAnnouncement, DepthImage, Event, VehicleAnnouncement
from nodes.mcap import native
from nodes.mcap.arrays import HOLDERS
from nodes.mcap.mcap_file import McapWriter
from nodes.mcap_recorder.settings import McapRecorderConfig
from nodes.ros2_bridge.plan import publication
from nodes.ros2_bridge.publishing import Publishing
from nodes.ros2_bridge.session import Session
from nodes.ros2_bridge.settings import KINDS, Ros2BridgeConfig
from nodes.ros_messages.depth import COMPRESSED, DEPTH_HEAD
from nodes.ros_messages.frame_names import FrameNames
from nodes.ros_messages.images import make_header
from nodes.ros_messages.stamps import Stamps
from nodes.ros_messages.topics import Topic, ros_name
from nodes.ros_messages.typestore import TypeStore
from runtime.errors import WireError
from runtime.wire import event_type, unpack

PREFIX = "/visnav"
"""Before the topics of events as they are."""

_LATCHED = (
    "- history: keep_last\n  depth: 1\n  reliability: reliable\n  durability: transient_local\n"
    "  deadline: {sec: 9223372036, nsec: 854775807}\n"
    "  lifespan: {sec: 9223372036, nsec: 854775807}\n"
    "  liveliness: automatic\n  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""As rosbag2 writes it; a player then offers the transforms to those that come late."""


class Topics:
    """Writes events to a file.

    Args:
        writer: Of the file.
        config: The recorder's settings.
        complain: Told of events that are recorded as they are, but not as ROS's messages.
    """

    def __init__(
        self, writer: McapWriter, config: McapRecorderConfig, complain: Callable[[str], None]
    ) -> None:
        self._writer = writer
        self._complain = complain
        self._store = TypeStore(config.distribution)
        self._depth_as_png = config.depth == "png"
        self._names = Ros2BridgeConfig(
            publish=tuple(kind for kind in KINDS if kind != "clock"),
            distribution=config.distribution,
            raw=config.images == "raw",
            compressed="" if config.images == "raw" else config.images,
            jpeg_quality=config.jpeg_quality,
        )
        # All that it asks of a session is publishers.
        session = cast("Session", self)
        self._ros = Publishing(session, self._store, self._names, Stamps().out)
        self._frames = FrameNames()
        self._puts: dict[str, Any] = {}
        self._own: dict[tuple[str, str, str], int] = {}
        self._depth_topics: dict[str, _Topic] = {}
        self._definitions: dict[str, str] = {}
        self._begun = False
        self.time = 0
        self.holder = ""
        """Topic that has got the arrays of the event at hand."""

    def write(self, time: int, frame: bytes | bytearray, announcement: bool) -> None:
        """Write an event.

        Args:
            time: When it was published (ns).
            frame: What was said, as `runtime.wire` has it.
            announcement: Whether it is one.

        Raises:
            WireError: It is no frame.
        """
        self.time = time
        self.holder = ""
        kind, source = native.describe(frame)
        if not announcement and not self._begun:
            self._begun = True
            self._ros.begin()
        try:
            put = self._puts[kind]
        except KeyError:
            put = self._puts[kind] = self._putter(kind)
        if put is not None:
            try:
                put(unpack(frame))
            except (ValueError, TypeError, OverflowError, struct.error, cv2.error) as error:
                self.holder = ""
                self._complain(f"{kind} of {source} has no message: {error}")
        self._write_own(kind, source, frame, announcement)

    def publisher(self, topic: Topic) -> _Topic:
        """Return where the bridge puts messages of a topic."""
        qos = {"offered_qos_profiles": _LATCHED if topic.qos.transient_local else ""}
        return _Topic(self, topic, self.add_channel(topic.name, topic.type, qos))

    def add_channel(self, topic: str, type_: str, metadata: dict[str, str]) -> int:
        """Add a topic to the file."""
        if type_ not in self._definitions:
            self._definitions[type_] = self._store.definition(type_)
        return self._writer.channel(topic, type_, self._definitions[type_], metadata)

    def put(self, channel: int, data: bytes | bytearray) -> None:
        """Write a message of the event at hand."""
        self._writer.write(channel, self.time, data)

    def _putter(self, kind: str) -> Any:
        """Return what writes ROS's messages of a kind of event; `None` if there are none."""
        cls = _type_of(kind)
        if cls is None:
            return None
        if issubclass(cls, Announcement):
            return self._announced
        if issubclass(cls, DepthImage) and self._depth_as_png:
            return self._put_depth
        for base, put in self._ros.large.items():
            if issubclass(cls, base):
                return put
        return self._ros.small if self._ros.knows(cls) else None

    def _announced(self, event: Announcement) -> None:
        if isinstance(event, CameraAnnouncement):
            self._frames.add(event)
        elif isinstance(event, VehicleAnnouncement):
            self._frames.add_vehicle(event.source)
        self._ros.announced(event)

    def _put_depth(self, event: DepthImage) -> None:
        topic = self._depth_topics.get(event.source)
        if topic is None:
            found = publication("depth", event.source, self._names)
            assert found is not None
            name = f"{found.topic}/compressedDepth"
            topic = self.publisher(Topic(name=name, type=COMPRESSED, hash=""))
            self._depth_topics[event.source] = topic
        _, png = cv2.imencode(".png", in_millimetres(event.data))
        message = self._store.message(COMPRESSED)(
            header=make_header(
                self._store,
                Stamps().out(event.stamp),
                self._frames.name(event.frame_id, event.source),
            ),
            format="16UC1; compressedDepth png",
            data=np.frombuffer(DEPTH_HEAD.pack(0, 0.0, 0.0) + png.tobytes(), np.uint8),
        )
        topic.put(self._store.serialize(message))

    def _write_own(
        self, kind: str, source: str, frame: bytes | bytearray, announcement: bool
    ) -> None:
        channel = self._own.get((kind, source, self.holder))
        if channel is None:
            metadata = {
                "kind": kind,
                "source": source,
                "announcement": "true" if announcement else "",
                "arrays": self.holder,
            }
            name = re.sub(r"\W", "_", kind.rpartition(":")[2])
            topic = f"{PREFIX}/{ros_name(source)}/{name}"
            channel = self.add_channel(topic, native.TYPE, metadata)
            self._own[kind, source, self.holder] = channel
        self.put(channel, native.message(frame, arrays=not self.holder))


class _Topic:
    """Stands in for the bridge's publisher of a topic."""

    def __init__(self, topics: Topics, topic: Topic, channel: int) -> None:
        self._topics = topics
        self._channel = channel
        self._name = topic.name
        self._holds = topic.type in HOLDERS

    def put(self, data: bytes | bytearray) -> None:
        """Write a message."""
        if self._holds:
            self._topics.holder = self._name
        self._topics.put(self._channel, data)


def in_millimetres(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Return depth in whole millimetres, 0 where there is none or more than 65.535 m of it."""
    steps = np.rint(depth * np.float32(1000.0))
    there = np.isfinite(steps) & (steps >= 1.0) & (steps <= 65535.0)
    return np.where(there, steps, 0.0).astype(np.uint16)


def _type_of(kind: str) -> type[Event] | None:
    """Return a type of event, imported if need be; `None` for what only its own process knows."""
    with contextlib.suppress(WireError):
        return event_type(kind)
    with contextlib.suppress(Exception):  # a module of the user's own, which may do anything
        importlib.import_module(kind.partition(":")[0])
        return event_type(kind)
    return None
