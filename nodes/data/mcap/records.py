"""What stands in an MCAP file, sound or not: its records, by its index or one after the other.

The only module that imports mcap (mcap.dev/spec).
"""

from __future__ import annotations

import contextlib
import dataclasses
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from nodes.data.mcap import layout
from nodes.data.mcap.disk import RecordingError
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

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
    "Attachment",
    "Channel",
    "Message",
    "Metadata",
    "Schema",
    "check",
    "header_of",
    "metadata_of",
    "open_file",
    "records",
    "summary_of",
    "writer",
]

_DAMAGED = (struct.error, EOFError, ValueError, OSError, OverflowError, MemoryError, LookupError)
"""What mcap raises when it reads what is no record, beside its own errors."""

_TIMES = struct.Struct("<QQ")
"""At the beginning of a chunk: of its first message, and of its last."""


def writer(
    file: IO[bytes], *, compression: str, chunk_size: int, profile: str, library: str
) -> Writer:
    """Return mcap's writer of a file, which it has begun.

    Args:
        file: To write into.
        compression: Of chunks: ``zstd``, ``lz4`` or ``none``.
        chunk_size: Bytes of a chunk.
        profile: What the file is for, for its header.
        library: Which wrote it.

    Raises:
        OSError: It cannot be written.
    """
    found = Writer(
        file,
        chunk_size=chunk_size,
        compression=CompressionType[compression.upper()],
        use_summary_offsets=False,  # optional, and its writer makes them of empty groups too
    )
    found.start(profile=profile, library=library)
    return found


def open_file(path: Path) -> IO[bytes]:
    """Open an MCAP file.

    Raises:
        RecordingError: It is none.
        MissingDependencyError: mcap is not installed.
    """
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
    """Make sure that mcap is there.

    Raises:
        MissingDependencyError: It is not.
    """
    if _MISSING is not None:
        raise MissingDependencyError(
            f"recordings need mcap: {install_command('record')}"
        ) from _MISSING


def header_of(file: IO[bytes]) -> Header:
    """Return a file's header, or an empty one if that is damaged."""
    with contextlib.suppress(McapError, *_DAMAGED):
        for opcode, content in layout.pieces(file, {Opcode.HEADER}):
            found: Header = _parsed(opcode, content)
            return found
    return Header("", "")


def summary_of(file: IO[bytes]) -> Summary | None:
    """Return a file's index, if it has one that is sound."""
    if not layout.has_summary(file):
        return None
    file.seek(0)
    try:
        return SeekingReader(file).get_summary()
    except (McapError, *_DAMAGED):
        return None


def metadata_of(file: IO[bytes], summary: Summary) -> dict[str, dict[str, str]]:
    """Return a file's metadata by name; none from where it is damaged."""
    found: dict[str, dict[str, str]] = {}
    with contextlib.suppress(McapError, *_DAMAGED):
        for index in summary.metadata_indexes:
            content = layout.piece_at(file, index.offset, index.length)
            found[index.name] = dict(_parsed(Opcode.METADATA, content).metadata)
    return found


def records(
    path: Path,
    start: int,
    end: int | None,
    damaged: Callable[[str], None],
    everything: bool = False,
) -> Iterator[Any]:
    """Yield schemas, channels and messages; of a file with an index, by its chunks in the range.

    Args:
        path: The file.
        start: Messages before this time (ns) may be left out.
        end: So may those at this time and after.
        damaged: Called for parts that cannot be read, which are passed over.
        everything: Yield metadata and attachments, too.

    Raises:
        RecordingError: It is no MCAP file.
    """
    with open_file(path) as file:
        summary = summary_of(file)
        if summary is not None and summary.chunk_indexes and summary.channels:
            found = _by_index(file, summary, start, end, damaged, everything)
        else:
            found = _one_by_one(file, damaged, everything)
        known: set[int] = set()
        strange = False
        for record in found:
            if isinstance(record, Channel):
                known.add(record.id)
            elif isinstance(record, Message) and record.channel_id not in known:
                if not strange:
                    strange = True
                    damaged("messages of topics that a damaged chunk named are left out")
                continue
            yield record


def _by_index(
    file: IO[bytes],
    summary: Summary,
    start: int,
    end: int | None,
    damaged: Callable[[str], None],
    everything: bool,
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
    if everything:
        for opcode, found in (
            (Opcode.METADATA, summary.metadata_indexes),
            (Opcode.ATTACHMENT, summary.attachment_indexes),
        ):
            for each in found:
                try:
                    yield _parsed(opcode, layout.piece_at(file, each.offset, each.length))
                except (McapError, *_DAMAGED) as error:
                    damaged(f"{each.name} is damaged and left out ({error})")


def _one_by_one(file: IO[bytes], damaged: Callable[[str], None], everything: bool) -> Iterator[Any]:
    wanted = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}
    if everything:
        wanted |= {Opcode.METADATA, Opcode.ATTACHMENT}
    try:
        for opcode, content in layout.pieces(file, wanted):
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
    """Return a record.

    Raises:
        McapError: It is damaged; or one of `_DAMAGED`.
    """
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
    """Return the records of a chunk; none if it is damaged."""
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
    """Return a chunk without compression: however much comes out, no more is made than it says."""
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
