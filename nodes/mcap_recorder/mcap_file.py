"""MCAP files, written so that a killed process loses little, and read even if they are torn.

The only module that imports mcap (mcap.dev/spec). What the messages mean is not known here.

A file grows by whole chunks, which go to the system in one piece and unbuffered: what was written
survives the process, however it ends (a power cut only with `fsync`). A torn file has no index
and perhaps half a chunk at its end; `read` reads it all the same, and `recover` mends it.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import msgspec

from nodes.mcap_recorder.disk import RecordingError, WholeWrites, unwritable
from runtime.errors import MissingDependencyError

try:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.reader import SeekingReader
    from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk
    from mcap.writer import CompressionType, Writer

    _MISSING: ImportError | None = None
except ImportError as error:
    _MISSING = error

Compression = Literal["zstd", "lz4", "none"]

LIBRARY = "visnav-runtime"
"""Which wrote a file, as its header tells."""

_TORN = (struct.error, EOFError, ValueError)
"""What mcap raises at the end of a torn file, beside its own errors."""


class Record(NamedTuple):
    """A message of a recording.

    Attributes:
        topic: Of its channel.
        type: Name of its schema.
        metadata: Of its channel.
        time: When it was published, nanoseconds.
        sequence: Number of the event that it came from.
        data: Its bytes.
    """

    topic: str
    type: str
    metadata: Mapping[str, str]
    time: int
    sequence: int
    data: bytes


class Contents(msgspec.Struct, frozen=True):
    """What a file says of itself.

    Attributes:
        ours: Whether `McapWriter` wrote it.
        complete: Whether it was closed, and has an index.
        metadata: By name.
        end: Time of its last message (ns), if it has an index.
    """

    ours: bool
    complete: bool
    metadata: dict[str, dict[str, str]]
    end: int | None


class McapWriter:
    """Writes an MCAP file with ROS 2's profile.

    Args:
        path: The file; made anew.
        compression: Of chunks.
        chunk_size: Bytes after which a chunk is full.
        fsync: Wait for the disk at the end of each chunk.
        open_file: Makes the file; for tests.

    Raises:
        RecordingError: It cannot be made.
        MissingDependencyError: mcap is not installed.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression = "zstd",
        chunk_size: int = 4 << 20,
        fsync: bool = False,
        open_file: Callable[[Path], IO[bytes]] | None = None,
    ) -> None:
        _check()
        self.path = path
        self.messages = 0
        self._fsync = fsync
        self._schemas: dict[str, int] = {}
        self._pending = 0
        try:
            raw = open_file(path) if open_file else path.open("wb", buffering=0)
            self._file = WholeWrites(raw)  # type: ignore[arg-type]
            self._writer = Writer(
                self._file,  # type: ignore[arg-type]
                chunk_size=1 << 62,  # ends of chunks are ours to say
                compression=CompressionType[compression.upper()],
            )
            self._writer.start(profile="ros2", library=LIBRARY)
        except OSError as error:
            raise unwritable(path, error) from error
        self._chunk_size = chunk_size

    @property
    def size(self) -> int:
        """Return how many bytes were written."""
        return self._file.size

    def channel(
        self, topic: str, type_: str, definition: str, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Add a topic of CDR messages; return its number.

        Args:
            topic: Its name.
            type_: ``sensor_msgs/msg/Image``.
            definition: Text of the type and of those it is made of.
            metadata: More about the topic.
        """
        schema = self._schemas.get(type_)
        if schema is None:
            schema = self._writer.register_schema(type_, "ros2msg", definition.encode())
            self._schemas[type_] = schema
        return self._writer.register_channel(topic, "cdr", schema, dict(metadata or {}))

    def write(self, channel: int, time: int, sequence: int, data: bytes | bytearray) -> None:
        """Add a message; its bytes are copied."""
        self._writer.add_message(channel, time, data, time, sequence & 0xFFFFFFFF)  # type: ignore[arg-type]
        self.messages += 1
        self._pending += len(data)

    @property
    def full(self) -> bool:
        """Tell whether it is time to end the chunk."""
        return self._pending >= self._chunk_size

    def end_chunk(self) -> None:
        """Compress what has come, and give it to the system.

        Raises:
            RecordingError: The disk is full, or the like; what was written before is readable.
        """
        self._pending = 0
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error

    def close(self, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Write the index, and close the file.

        Raises:
            RecordingError: As for `end_chunk`.
        """
        try:
            self.end_chunk()
            for name, entries in (metadata or {}).items():
                self._writer.add_metadata(name, dict(entries))
            self._writer.finish()  # type: ignore[no-untyped-call]
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error
        finally:
            self._file.close()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file to the recording."""
        self._writer.add_attachment(0, 0, name, media_type, data)

    def abandon(self) -> None:
        """Close the file after an error, as a valid one without an index where there is room."""
        with contextlib.suppress(OSError):  # it is torn, then; `recover` mends it
            self._file.write(_END_WITHOUT_INDEX)
        self._file.close()


def contents(path: Path) -> Contents:
    """Return what a file says of itself.

    Raises:
        RecordingError: It is no MCAP file.
    """
    ours = False
    with _open(path) as file:
        try:
            reader = SeekingReader(file)
            ours = reader.get_header().library == LIBRARY
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return Contents(ours, False, {}, None)
            metadata = {each.name: dict(each.metadata) for each in reader.iter_metadata()}
            return Contents(ours, True, metadata, summary.statistics.message_end_time)
        except (McapError, OSError, *_TORN):  # an OSError: too short for a footer
            return Contents(ours, False, {}, None)


def read(
    path: Path, start: int = 0, end: int | None = None, damaged: Callable[[str], None] | None = None
) -> Iterator[Record]:
    """Yield the messages of a file in the order in which they were written.

    Args:
        path: The file; torn ones are read as far as they go.
        start: Messages before this time (ns) are left out.
        end: So are those at this time and after.
        damaged: Told of parts that cannot be read, which are passed over.

    Raises:
        RecordingError: It is no MCAP file.
    """
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    for record in _records(path, start, end, damaged or (lambda _: None)):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
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


def recover(path: Path, out: Path) -> tuple[int, list[str]]:
    """Write all that can be read of a file to another, complete and with an index.

    Returns:
        How many messages there were, and what could not be read.

    Raises:
        RecordingError: It is no MCAP file, or the other cannot be written.
    """
    trouble: list[str] = []
    messages = 0
    try:
        with out.open("wb") as file:
            writer = Writer(file, chunk_size=4 << 20, compression=CompressionType.ZSTD)
            writer.start(profile="ros2", library=LIBRARY)
            schemas: dict[int, int] = {0: 0}
            channels: dict[int, int] = {}
            for record in _records(path, 0, None, trouble.append, everything=True):
                match record:
                    case Schema():
                        if record.id not in schemas:
                            schema = record.name, record.encoding, record.data
                            schemas[record.id] = writer.register_schema(*schema)
                    case Channel(topic=topic, message_encoding=how, metadata=metadata):
                        if record.id not in channels:
                            schema_id = schemas.get(record.schema_id, 0)  # a damaged chunk's
                            number = writer.register_channel(topic, how, schema_id, metadata)
                            channels[record.id] = number
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case Attachment(create_time=made, log_time=time):
                        file_ = record.name, record.media_type, record.data
                        writer.add_attachment(made, time, *file_)
                    case Message(log_time=time, publish_time=published):
                        number = channels[record.channel_id]
                        writer.add_message(number, time, record.data, published, record.sequence)
                        messages += 1
            writer.finish()  # type: ignore[no-untyped-call]
    except OSError as error:
        raise unwritable(out, error) from error
    return messages, trouble


def _records(
    path: Path,
    start: int,
    end: int | None,
    damaged: Callable[[str], None],
    everything: bool = False,
) -> Iterator[Any]:
    """Yield schemas, channels and messages; of a file with an index, by its chunks in the range."""
    with _open(path) as file:
        summary = None
        if not everything:
            try:
                summary = SeekingReader(file).get_summary()
            except (McapError, OSError, *_TORN):
                summary = None
        if summary is not None and summary.chunk_indexes:
            yield from summary.schemas.values()
            yield from summary.channels.values()
            for index in summary.chunk_indexes:
                if index.message_end_time < start:
                    continue
                if end is not None and index.message_start_time >= end:
                    continue
                file.seek(index.chunk_start_offset + 9)  # after opcode and length
                yield from _broken_up(Chunk.read(ReadDataStream(file)), damaged)
            return
        file.seek(0)
        records = StreamReader(file, emit_chunks=True).records
        known: set[int] = set()
        strange = False
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except (McapError, *_TORN):
                if not _closed_early(file):
                    damaged("the end is missing: the file was not closed")
                return
            if isinstance(record, Chunk):
                for each in _broken_up(record, damaged):
                    if isinstance(each, Channel):
                        known.add(each.id)
                    if not isinstance(each, Message) or each.channel_id in known:
                        yield each
                    elif not strange:
                        strange = True
                        damaged("messages of topics that a damaged chunk named are left out")
            elif isinstance(record, Schema | Channel | Message) or (
                everything and isinstance(record, Metadata | Attachment)
            ):
                yield record


def _broken_up(chunk: Chunk, damaged: Callable[[str], None]) -> Iterator[Any]:
    try:
        records = breakup_chunk(chunk, validate_crc=True)
    except Exception as error:  # whatever its compression raises
        damaged(
            f"{chunk.message_start_time / 1e9:.3f} s to {chunk.message_end_time / 1e9:.3f} s: "
            f"a damaged chunk is left out ({error})"
        )
        return
    yield from records


def _closed_early(file: IO[bytes]) -> bool:
    """Tell whether a file ends as `McapWriter.abandon` ends it."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(size - len(_END_WITHOUT_INDEX), 0))
    return file.read() == _END_WITHOUT_INDEX


def _open(path: Path) -> IO[bytes]:
    _check()
    try:
        file = path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: expected a readable file, found: {error.strerror}") from None
    if file.read(len(_MAGIC)) != _MAGIC:
        file.close()
        raise RecordingError(f"{path}: expected an MCAP file, found something else")
    file.seek(0)
    return file


def _check() -> None:
    if _MISSING is not None:
        raise MissingDependencyError(
            "recordings need mcap: pip install 'visnav-runtime[record]'"
        ) from _MISSING


_MAGIC = b"\x89MCAP0\r\n"
_END_WITHOUT_INDEX = (
    struct.pack("<BQI", 0x0F, 4, 0)  # DataEnd, no checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # Footer: there is no summary
    + _MAGIC
)
