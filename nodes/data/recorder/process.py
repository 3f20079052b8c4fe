"""The recording process: reads events from its standard input, and writes the file.

Started by `writer_process` as ``python -m nodes.data.recorder.process``. A process of its own,
because encoding holds Python's lock for milliseconds, and to close the file of a killed run. Events
become ROS's messages, as the bridge makes them, and messages of their own. A large array stands in
the file once, in ROS's message; the event's own message lacks it, has the same time, and names that
topic in its channel.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec

from events import Announcement, Event
from nodes.data.mcap import native
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import McapWriter
from nodes.data.mcap.native import HOLDERS
from nodes.data.recorder import writer_process
from nodes.data.recorder.writer_process import McapRecorderConfig, Reply, WriteRequest
from nodes.ros2.messages.mappings import LARGE, SMALL, Publishing
from nodes.ros2.messages.topics import ALL_GROUPS, PublishingConfig, Topic, ros_name
from nodes.ros2.messages.typestore import Stamps, TypeStore
from runtime.channels.wire import event_type, unpack
from runtime.errors import MissingDependencyError, WireError

PREFIX = "/visnav"  # before the topics of events as they are
_LEFT_OUT = ("clock", "paths")  # topic groups left out, as they only repeat other topics
_LATCHED = (
    "- history: keep_last\n  depth: 1\n  reliability: reliable\n  durability: transient_local\n"
    "  deadline: {sec: 9223372036, nsec: 854775807}\n"
    "  lifespan: {sec: 9223372036, nsec: 854775807}\n"
    "  liveliness: automatic\n  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""Latched QoS as written by rosbag2; a player offers the transforms to late joiners."""


class EventWriter:
    """Writer of events to a file; as a `Sink`, target of `Publishing`'s ROS messages."""

    def __init__(
        self,
        writer: McapWriter,
        config: McapRecorderConfig,
        complain: Callable[[str], None],  # called for events not recorded as ROS's messages
    ) -> None:
        self._writer, self._complain = writer, complain
        self._store = TypeStore(config.distribution)
        published = PublishingConfig(
            publish=tuple(group for group in ALL_GROUPS if group not in _LEFT_OUT),
            raw_images=config.image_format == "raw",
            compressed_images="" if config.image_format == "raw" else config.image_format,
            raw_depth=config.depth_format == "raw",
            compressed_depth="" if config.depth_format == "raw" else "millimetres",
            jpeg_quality=config.jpeg_quality,
        )
        self._ros = Publishing(self, self._store, published, Stamps().out)
        self._ros_writers: dict[str, Any] = {}
        self._native_channels: dict[tuple[str, str, str], int] = {}
        self._started = False
        self._time = 0
        self._holder = ""  # topic holding the arrays of the current event

    def write(self, time: int, frame: bytes | bytearray, announcement: bool) -> None:
        """Write a frame of `channels.wire`, published at a time (ns); or raise a `WireError`."""
        self._time = time
        self._holder = ""
        kind, source = native.describe(frame)
        if not announcement and not self._started:
            self._started = True
            self._ros.begin()
        if kind not in self._ros_writers:
            self._ros_writers[kind] = self._ros_writer(kind)
        if (write_ros := self._ros_writers[kind]) is not None:
            try:
                write_ros(unpack(frame))
            except (ValueError, TypeError, OverflowError, struct.error, cv2.error) as error:
                self._holder = ""
                self._complain(f"{kind} of {source} has no message: {error}")
        self._write_native(kind, source, frame, announcement)

    def publisher(self, topic: Topic) -> RecordedTopic:
        """Add a topic of ROS's messages to the file."""
        qos = {"offered_qos_profiles": _LATCHED if topic.qos.transient_local else ""}
        channel = self._add_channel(topic.name, topic.type, qos)

        def write(message: bytearray) -> None:
            """Write a message of the current event."""
            if topic.type in HOLDERS:
                self._holder = topic.name
            self._writer.write(channel, self._time, message)

        return RecordedTopic(topic, write)

    def _add_channel(self, topic: str, type_: str, metadata: dict[str, str]) -> int:
        return self._writer.channel(topic, type_, self._store.definition, metadata)

    def _ros_writer(self, kind: str) -> Any:
        """Return the writer of ROS messages for a kind of event; `None` if none exist."""
        cls = _find_type(kind)
        if cls is None:
            return None
        if issubclass(cls, Announcement):
            return self._ros.announced
        return self._ros.put if issubclass(cls, LARGE + SMALL) else None

    def _write_native(
        self, kind: str, source: str, frame: bytes | bytearray, announcement: bool
    ) -> None:
        channel = self._native_channels.get((kind, source, self._holder))
        if channel is None:
            metadata = {
                "kind": kind,
                "source": source,
                "announcement": "true" if announcement else "",
                "arrays": self._holder,
            }
            name = re.sub(r"\W", "_", kind.rpartition(":")[2])
            topic = f"{PREFIX}/{ros_name(source)}/{name}"
            channel = self._add_channel(topic, native.TYPE, metadata)
            self._native_channels[kind, source, self._holder] = channel
        self._writer.write(channel, self._time, native.message(frame, arrays=not self._holder))


class RecordedTopic(msgspec.Struct, frozen=True):
    """A topic of ROS's messages in the file."""

    topic: Topic
    put: Callable[[bytearray], None]
    wanted: bool = True


def _find_type(kind: str) -> type[Event] | None:
    """Return an event type, imported if needed; `None` if unknown in this process."""
    with contextlib.suppress(WireError):
        return event_type(kind)
    with contextlib.suppress(Exception):  # a user's module may raise any error
        importlib.import_module(kind.partition(":")[0])
        return event_type(kind)
    return None


LONGEST = 0.4  # longest duration of a chunk: seconds, real and of the run's clock


class FileWriter:
    """Writer of a recording; a `RecordingError` if the file cannot be made."""

    def __init__(self, request: WriteRequest) -> None:
        config = request.config
        self._writer = McapWriter(
            Path(request.path),
            compression=config.compression,
            chunk_size=config.chunk_size,
            fsync=config.fsync,
        )
        attachment = Path(request.attachment)
        if attachment.is_file():
            self._writer.attach(attachment.name, "application/toml", attachment.read_bytes())
        self._events = EventWriter(self._writer, config, self._complain)
        self._metadata = request.metadata
        self._complaints: set[str] = set()
        self._written = 0
        self._in_chunk = 0
        self._chunk_start: tuple[float, int] | None = None  # real seconds, run's nanoseconds

    def run(self, file: int) -> Reply:
        """Write the pieces from a file descriptor, and close the file."""
        last = 0
        try:
            for piece in writer_process.read_all(file, LONGEST / 2, self._while_idle):
                last = piece.time
                if piece.kind == writer_process.END:
                    break
                self._write(piece)
            self._end_chunk()
            facts = {"end": str(last), "events": str(self._written)}
            self._writer.close({"visnav": facts})
            if self._metadata:
                try:
                    Path(self._metadata).write_text(self._writer.bag_metadata(), "utf-8")
                except OSError as error:
                    self._complain(f"{self._metadata}: cannot be written: {error.strerror}")
        except RecordingError as error:
            self._written -= self._in_chunk
            self._writer.abandon()
            return self._reply("error", str(error))
        return self._reply("done")

    def _write(self, piece: writer_process.Piece) -> None:
        try:
            self._events.write(piece.time, piece.frame, piece.kind == writer_process.ANNOUNCEMENT)
            self._written += 1
            self._in_chunk += 1
        except WireError as error:
            self._complain(str(error))
        if self._chunk_start is None:
            self._chunk_start = time.monotonic(), piece.time
        real, run = self._chunk_start
        if (
            self._writer.full
            or piece.time - run >= LONGEST * 1e9
            or time.monotonic() - real >= LONGEST
        ):
            self._end_chunk()

    def _while_idle(self) -> None:
        if self._chunk_start and time.monotonic() - self._chunk_start[0] >= LONGEST:
            self._end_chunk()

    def _end_chunk(self) -> None:
        self._chunk_start = None
        self._writer.end_chunk()
        self._in_chunk = 0

    def _complain(self, text: str) -> None:
        if text not in self._complaints:
            self._complaints.add(text)
            send(Reply("complaint", text))

    def _reply(self, kind: str, text: str = "") -> Reply:
        return Reply(kind, text, self._written, self._writer.size)


def send(reply: Reply) -> None:
    """Send a reply to the run, if still there."""
    line = msgspec.json.encode(reply) + b"\n"
    try:
        while line:
            line = line[os.write(sys.stdout.fileno(), line) :]
    except OSError:
        pass


def main(request: str) -> None:
    """Carry out a write request, and reply with the result."""
    for number in (signal.SIGINT, signal.SIGHUP):  # the run handles the terminal's signals
        signal.signal(number, signal.SIG_IGN)
    write_request = msgspec.json.decode(request, type=WriteRequest)
    os.nice(write_request.niceness)
    if write_request.cores:
        os.sched_setaffinity(0, write_request.cores)
    try:
        writer = FileWriter(write_request)
    except RecordingError as error:
        send(Reply("error", str(error)))
        return
    except MissingDependencyError as error:
        send(Reply("missing", str(error)))
        return
    send(Reply("ready"))
    send(writer.run(sys.stdin.fileno()))


if __name__ == "__main__":
    main(sys.argv[1])
