"""Records of an MCAP file, intact or damaged, and events in their own encoding.

The only module that imports mcap (mcap.dev/spec). An event is a ``std_msgs/msg/UInt8MultiArray``:
``ros2 bag`` refuses files that mix encodings with CDR. Its data is a frame of
`runtime.channels.wire`; or, if the arrays stand in another message of the same time, the frame's
beginning, up to its arrays.
"""

from __future__ import annotations

import contextlib
import dataclasses
import struct
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import Event
from events.frames import Axes, convert_points
from nodes.data.mcap import layout
from nodes.data.mcap.layout import RecordingError
from nodes.ros2.messages.images import COMPRESSED, LIDAR_POINT, POINT, decode_compressed
from nodes.ros2.messages.typestore import TypeStore
from runtime.channels.wire import ALIGNED, unpack
from runtime.errors import MissingDependencyError, WireError
from runtime.extras import install_command

TYPE = "std_msgs/msg/UInt8MultiArray"
_LENGTH = struct.Struct("<I")
_HEAD = struct.Struct("<4sIII")  # CDR's header (little endian), no dimensions, no offset, size
_CDR = b"\x00\x01\x00\x00"

_decode = msgspec.msgpack.Decoder(tuple[str, list[tuple[str, list[int], int]], msgspec.Raw]).decode


class Shape(msgspec.Struct, frozen=True):
    """Array of a frame, present or lacking; its `dtype` as numpy writes it."""

    dtype: str
    shape: tuple[int, ...]


def message(frame: bytes | bytearray | memoryview, arrays: bool = True) -> bytes:
    """Return a frame of `runtime.channels.wire` as a message, with or without its arrays."""
    size = len(frame) if arrays else _LENGTH.size + _LENGTH.unpack_from(frame)[0]
    return b"".join((_HEAD.pack(_CDR, 0, 0, size), memoryview(frame)[:size]))


def describe(frame: bytes | bytearray | memoryview) -> tuple[str, str]:
    """Return the kind and the source of a frame's event; a `WireError` if it is no frame."""
    kind, _, head, _ = _head(memoryview(frame), _source)
    return kind, head.source


def missing_arrays(data: bytes) -> list[Shape]:
    """Return the arrays missing in a message, none or all; a `WireError` if it is none of ours."""
    shapes, start, end = _shapes(data)
    content = any(0 not in shape for _, shape, _ in shapes)
    if not shapes or len(data) - _HEAD.size > end or (not content and start == end):
        return []
    return [Shape(dtype, tuple(shape)) for dtype, shape, _ in shapes]


def fields(data: bytes) -> dict[str, Any]:
    """Return an event's fields as msgpack has them, arrays as numbers; may raise `WireError`."""
    values: dict[str, Any] = _head(memoryview(data)[_HEAD.size :], msgspec.msgpack.decode)[2]
    return values


def event(data: bytes, arrays: Sequence[npt.NDArray[Any]] = ()) -> Event:
    """Return a message's event; a `WireError` if arrays do not fit, or its type is unknown."""
    if not arrays:
        return unpack(memoryview(data)[_HEAD.size :])
    shapes, start, end = _shapes(data)
    if [(np.dtype(d), tuple(s)) for d, s, _ in shapes] != [(a.dtype, a.shape) for a in arrays]:
        actual = ", ".join(f"{a.dtype}{list(a.shape)}" for a in arrays)
        raise WireError(f"expected arrays of {[(d, s) for d, s, _ in shapes]}, found {actual}")
    size = start + max(at + a.nbytes for (_, _, at), a in zip(shapes, arrays, strict=True))
    frame = np.empty(size, np.uint8)
    frame[:end] = np.frombuffer(data, np.uint8, end, _HEAD.size)
    for (_, _, at), array in zip(shapes, arrays, strict=True):
        place = frame[start + at : start + at + array.nbytes]
        place[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return unpack(frame.data)


class _Source(msgspec.Struct):
    source: str


_source = msgspec.msgpack.Decoder(_Source).decode


Shapes = list[tuple[str, list[int], int]]


def _shapes(data: bytes) -> tuple[Shapes, int, int]:
    """Return a frame's arrays, the offset of their data, and the end of its head."""
    _, shapes, _, end = _head(memoryview(data)[_HEAD.size :])
    return shapes, -(-end // ALIGNED) * ALIGNED, end


def _head(
    frame: memoryview, decode: Callable[[msgspec.Raw], Any] = lambda _: None
) -> tuple[str, Shapes, Any, int]:
    """Return a frame's kind, its arrays, its decoded fields, and where its head ends."""
    try:
        (length,) = _LENGTH.unpack_from(frame)
        end = _LENGTH.size + length
        kind, shapes, content = _decode(frame[_LENGTH.size : end])
        return kind, shapes, decode(content), end
    except (struct.error, msgspec.DecodeError) as error:
        raise WireError(f"expected an event, found something else: {error}") from error


Array = npt.NDArray[Any]

HOLDERS = {
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/PointCloud2",
}  # message types with room for an event's arrays


def arrays(
    store: TypeStore, data: bytes, type_: str, shapes: list[Shape], axes: Axes
) -> list[Array]:
    """Return an event's arrays; a `ValueError` if the message has no such arrays."""
    message = store.deserialize(data, type_)
    try:
        if type_.endswith("PointCloud2"):
            return _cloud(message, shapes, axes)
        (shape,) = shapes
        if type_ == COMPRESSED:
            pixels = decode_compressed(message)
        else:
            pixels = np.frombuffer(message.data, np.dtype(shape.dtype)).reshape(shape.shape)
    except (ValueError, cv2.error) as error:
        raise ValueError(f"expected arrays of {shapes}, found others: {error}") from error
    return [pixels]


def _cloud(message: Any, shapes: list[Shape], axes: Axes) -> list[Array]:
    """Return the arrays of a cloud or of a lidar's turn, in the order of the event's fields.

    Colours are there if there is room for them: all are white where there were none.
    """
    scan = message.point_step == LIDAR_POINT.itemsize
    rows = np.frombuffer(message.data, LIDAR_POINT if scan else POINT, shapes[0].shape[0])
    points = convert_points(axes, np.ascontiguousarray(rows["xyz"]))
    if scan:
        return [points, *(np.ascontiguousarray(rows[n]) for n in ("intensity", "time", "ring"))]
    counts = [colors.shape[0] for colors in shapes[1:]]
    return [points, *(np.ascontiguousarray(rows["bgr"][:count, ::-1]) for count in counts)]


try:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.reader import SeekingReader
    from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
    from mcap.stream_reader import breakup_chunk
    from mcap.summary import Summary
    from mcap.writer import CompressionType, Writer
    from zstandard import ZstdDecompressor

    _MISSING: ImportError | None = None
except ImportError as error:
    _MISSING = error

__all__ = [
    "Attachment", "Channel", "Message", "Metadata", "Schema", "check", "header_of", "metadata_of",
    "open_file", "records", "summary_of", "writer",
]  # fmt: skip

_DAMAGED = (struct.error, EOFError, ValueError, OSError, OverflowError, MemoryError, LookupError)
"""Exceptions of mcap on damaged records, besides its own errors."""
_TIMES = struct.Struct("<QQ")  # at the beginning of a chunk: of its first message, and of its last


def writer(
    file: IO[bytes], *, compression: str, chunk_size: int, profile: str, library: str
) -> Writer:
    """Return mcap's writer of a file, already started.

    Args:
        compression: Of chunks: ``zstd``, ``lz4`` or ``none``.

    Raises:
        OSError: It cannot be written.
    """
    writer = Writer(
        file,
        chunk_size=chunk_size,
        compression=CompressionType[compression.upper()],
        use_summary_offsets=False,  # optional, and its writer makes them of empty groups too
    )
    writer.start(profile=profile, library=library)
    return writer


def open_file(path: Path) -> IO[bytes]:
    """Open an MCAP file; a `RecordingError` if it is none."""
    check()
    try:
        file = path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: expected a readable file, found: {error.strerror}") from None
    if file.read(len(layout.MAGIC)) != layout.MAGIC:
        file.close()
        raise RecordingError(f"{path}: expected an MCAP file, found something else")
    return file


def check() -> None:
    """Raise a `MissingDependencyError` if mcap is missing."""
    if _MISSING is not None:
        raise MissingDependencyError(
            f"recordings need mcap: {install_command('record')}"
        ) from _MISSING


def header_of(file: IO[bytes]) -> Header:
    """Return a file's header, empty if damaged."""
    with contextlib.suppress(McapError, *_DAMAGED):
        for opcode, content in layout.pieces(file, {Opcode.HEADER}):
            header: Header = _parsed(opcode, content)
            return header
    return Header("", "")


def summary_of(file: IO[bytes]) -> Summary | None:
    """Return a file's index; `None` if missing or damaged."""
    if not layout.has_summary(file):
        return None
    file.seek(0)
    try:
        return SeekingReader(file).get_summary()
    except (McapError, *_DAMAGED):
        return None


def metadata_of(file: IO[bytes], summary: Summary) -> dict[str, dict[str, str]]:
    """Return a file's metadata by name, up to the first damaged record."""
    metadata: dict[str, dict[str, str]] = {}
    with contextlib.suppress(McapError, *_DAMAGED):
        for index in summary.metadata_indexes:
            content = layout.piece_at(file, index.offset, index.length)
            metadata[index.name] = dict(_parsed(Opcode.METADATA, content).metadata)
    return metadata


def records(
    path: Path,
    start: int,  # earlier messages (ns) may be left out
    end: int | None,  # so may those from this time on
    damaged: Callable[[str], None],  # called for parts that cannot be read, which are passed over
    with_metadata: bool = False,  # yield metadata and attachments, too
) -> Iterator[Any]:
    """Yield schemas, channels and messages; of a file with an index, by its chunks in the range."""
    with open_file(path) as file:
        summary = summary_of(file)
        if summary is not None and summary.chunk_indexes and summary.channels:
            stored = _by_index(file, summary, start, end, damaged, with_metadata)
        else:
            stored = _one_by_one(file, damaged, with_metadata)
        channels: set[int] = set()
        reported = False
        for record in stored:
            if isinstance(record, Channel):
                channels.add(record.id)
            elif isinstance(record, Message) and record.channel_id not in channels:
                if not reported:
                    reported = True
                    damaged("messages of topics that a damaged chunk named are left out")
                continue
            yield record


def _by_index(
    file: IO[bytes],
    summary: Summary,
    start: int,
    end: int | None,
    damaged: Callable[[str], None],
    with_metadata: bool,
) -> Iterator[Any]:
    yield from summary.schemas.values()
    yield from summary.channels.values()
    for index in summary.chunk_indexes:
        first, last = index.message_start_time, index.message_end_time
        if last >= start and (end is None or first < end):
            try:
                content = layout.piece_at(file, index.chunk_start_offset, index.chunk_length)
            except _DAMAGED as error:
                damaged(_left_out(first, last, error))
            else:
                yield from _broken_up(content, damaged)
    if with_metadata:
        for opcode, indexes in (
            (Opcode.METADATA, summary.metadata_indexes),
            (Opcode.ATTACHMENT, summary.attachment_indexes),
        ):
            for entry in indexes:
                try:
                    yield _parsed(opcode, layout.piece_at(file, entry.offset, entry.length))
                except (McapError, *_DAMAGED) as error:
                    damaged(f"{entry.name} is damaged and left out ({error})")


def _one_by_one(
    file: IO[bytes], damaged: Callable[[str], None], with_metadata: bool
) -> Iterator[Any]:
    opcodes = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}
    if with_metadata:
        opcodes |= {Opcode.METADATA, Opcode.ATTACHMENT}
    try:
        for opcode, content in layout.pieces(file, opcodes):
            if opcode == Opcode.CHUNK:
                yield from _broken_up(content, damaged)
                continue
            try:
                yield _parsed(opcode, content)
            except (McapError, *_DAMAGED) as error:
                damaged(f"a damaged record is left out ({error})")
    except layout.TornError as error:
        damaged(str(error))


def _parsed(opcode: int, content: bytes) -> Any:
    """Return a record; raise a `McapError` or one of `_DAMAGED` if damaged."""
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.MESSAGE:
        return Message.read(stream, len(content))
    kinds: dict[int, Any] = {
        Opcode.HEADER: Header,
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.METADATA: Metadata,
        Opcode.ATTACHMENT: Attachment,
    }
    return kinds[opcode].read(stream)


def _broken_up(content: bytes, damaged: Callable[[str], None]) -> list[Any]:
    stream = ReadDataStream(BytesIO(content))
    try:
        layout.check_chunk(content)
        chunk = Chunk.read(stream)
        if stream.count != len(content):
            raise ValueError(f"expected {len(content)} bytes, found {stream.count}")
        return breakup_chunk(_unpacked(chunk), validate_crc=True)
    except Exception as error:  # whatever its compression raises
        first, last = _TIMES.unpack_from(content) if len(content) >= _TIMES.size else (0, 0)
        damaged(_left_out(first, last, error))
        return []


def _unpacked(chunk: Chunk) -> Chunk:
    """Return a chunk uncompressed, unpacking no more than the claimed size."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        data = (
            ZstdDecompressor(max_window_size=layout.LARGEST)
            .stream_reader(chunk.data)
            .read(size + 1)
        )
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    else:
        return chunk
    if len(data) != size:
        raise ValueError(f"expected {size} bytes, found {len(data)}{'+' * (len(data) > size)}")
    return dataclasses.replace(chunk, compression="", data=data)


def _left_out(first: int, last: int, error: Exception) -> str:
    return f"{first / 1e9:.3f} s to {last / 1e9:.3f} s: a damaged chunk is left out ({error})"
