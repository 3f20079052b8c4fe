"""MCAP files: written with little loss if the process is killed, and read even if torn.

A file grows by whole chunks, written unbuffered in one piece: they survive the process, however it
ends (a power cut only with `fsync`). A torn file has no index and perhaps half a chunk at its end;
`read` reads it all the same, and `recover` mends it. Contents are for `native`.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Literal, NamedTuple

import msgspec

from nodes.data.mcap import layout
from nodes.data.mcap import native as records
from nodes.data.mcap.layout import WholeWrites, open_for_writing, unwritable

Compression = Literal["zstd", "lz4", "none"]

LIBRARY = "visnav-runtime"  # writer library in a file's header


class Record(NamedTuple):
    """A message of a recording."""

    topic: str
    type: str
    metadata: Mapping[str, str]
    time: int  # of publication, nanoseconds
    sequence: int  # number in its channel, from 0; a gap means a loss
    data: bytes


class Contents(msgspec.Struct, frozen=True):
    """Writer, state and metadata of a file."""

    ours: bool  # whether `McapWriter` wrote it
    complete: bool  # whether it was closed, and has an index
    metadata: dict[str, dict[str, str]]


class McapWriter:
    """Writes an MCAP file with ROS 2's profile.

    Raises:
        RecordingError: It cannot be made.
        MissingDependencyError: mcap is not installed.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression = "zstd",
        chunk_size: int = 4 << 20,  # bytes after which a chunk is full
        fsync: bool = False,  # wait for the disk at the end of each chunk
        open_file: Callable[[Path], IO[bytes]] | None = None,
    ) -> None:
        records.check()
        self.path = path
        self.messages = 0
        self._fsync = fsync
        self._schemas: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._topics: dict[int, dict[str, str]] = {}
        self._times: tuple[int, int] | None = None
        self._pending = 0
        try:
            self._file = WholeWrites((open_file or open_for_writing)(path))  # type: ignore[arg-type]
            self._writer = records.writer(
                self._file,  # type: ignore[arg-type]
                compression=compression,
                chunk_size=1 << 62,  # chunks are ended here, not by size
                profile="ros2",
                library=LIBRARY,
            )
            self._file.flush()
        except OSError as error:
            raise unwritable(path, error) from error
        self._chunk_size = chunk_size

    @property
    def size(self) -> int:
        """Return how many bytes were written."""
        return self._file.size

    def channel(
        self,
        topic: str,
        type_: str,  # ``sensor_msgs/msg/Image``
        definition: Callable[[str], str],  # returns the text of the type and of those it is made of
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Add a topic of CDR messages; return its number."""
        if type_ not in self._schemas:
            text = definition(type_).encode()
            self._schemas[type_] = self._writer.register_schema(type_, "ros2msg", text)
        channel = self._writer.register_channel(
            topic, "cdr", self._schemas[type_], dict(metadata or {})
        )
        self._topics[channel] = {
            "name": topic,
            "type": type_,
            "serialization_format": "cdr",
            "offered_qos_profiles": (metadata or {}).get("offered_qos_profiles", ""),
        }
        return channel

    def write(self, channel: int, time: int, data: bytes | bytearray) -> None:
        """Add a message, with the next number of its channel; its bytes are copied."""
        sequence = self._counts.get(channel, 0)
        self._counts[channel] = (sequence + 1) & 0xFFFFFFFF
        self._writer.add_message(channel, time, data, time, sequence)  # type: ignore[arg-type]
        self.messages += 1
        first, last = self._times or (time, time)
        self._times = min(first, time), max(last, time)
        self._pending += len(data)

    @property
    def full(self) -> bool:
        """Return whether the chunk has reached its size."""
        return self._pending >= self._chunk_size

    def end_chunk(self) -> None:
        """Compress and write the pending messages; a `RecordingError` if the disk is full."""
        self._pending = 0
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error

    def close(self, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Write the index, and close the file; a `RecordingError` leaves it open, for `abandon`."""
        try:
            self.end_chunk()
            for name, entries in (metadata or {}).items():
                self._writer.add_metadata(name, dict(entries))
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error
        self._file.close()

    def bag_metadata(self) -> str:
        """Return the metadata.yaml text to make the file's folder a ROS 2 bag."""
        first, last = self._times or (0, 0)
        facts = {
            "starting_time": {"nanoseconds_since_epoch": first},
            "duration": {"nanoseconds": last - first},
            "message_count": self.messages,
        }
        counts = {topic["name"]: 0 for topic in self._topics.values()}
        for channel, count in self._counts.items():
            counts[self._topics[channel]["name"]] += count
        topics = {topic["name"]: topic for topic in self._topics.values()}
        bag = facts | {
            "version": 5,
            "storage_identifier": "mcap",
            "relative_file_paths": [self.path.name],
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": counts[name]}
                for name, topic in topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [facts | {"path": self.path.name}],
        }
        # All JSON is YAML.
        return json.dumps({"rosbag2_bagfile_information": bag}, indent=1) + "\n"

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file to the recording."""
        self._writer.add_attachment(0, 0, name, media_type, data)

    def abandon(self) -> None:
        """Close the file after an error: valid without an index, space permitting."""
        with contextlib.suppress(OSError):  # it is torn, then; `recover` mends it
            self._file.write(layout.END_WITHOUT_INDEX)
            self._file.flush()
        self._file.close()


def contents(path: Path) -> Contents:
    """Return a file's writer, state and metadata; a `RecordingError` if it is no MCAP file."""
    with records.open_file(path) as file:
        ours = records.header_of(file).library == LIBRARY
        summary = records.summary_of(file)
        if summary is None or summary.statistics is None:
            return Contents(ours, False, {})
        return Contents(ours, True, records.metadata_of(file, summary))


def read(
    path: Path, start: int = 0, end: int | None = None, damaged: Callable[[str], None] | None = None
) -> Iterator[Record]:
    """Yield the messages of a file in the order of writing.

    Args:
        start: First time (ns) of messages.
        end: Time (ns) before which messages end.
        damaged: Called for parts that cannot be read, which are passed over.

    Raises:
        RecordingError: It is no MCAP file.
    """
    channels: dict[int, records.Channel] = {}
    schemas: dict[int, records.Schema] = {}
    for record in records.records(path, start, end, damaged or (lambda _: None)):
        if isinstance(record, records.Schema):
            schemas[record.id] = record
        elif isinstance(record, records.Channel):
            channels[record.id] = record
        elif start <= record.log_time and (end is None or record.log_time < end):
            channel = channels[record.channel_id]
            schema = schemas.get(channel.schema_id)
            yield Record(
                channel.topic,
                schema.name if schema else "",
                channel.metadata,
                record.log_time,
                record.sequence,
                record.data,
            )
