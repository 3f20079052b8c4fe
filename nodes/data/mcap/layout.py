"""The bytes of an MCAP file from outside: its records, its index, and how they reach the disk.

Needs no mcap: no more of the format (mcap.dev/spec) than finds the records of a file that may be
torn or damaged anywhere, where mcap's own readers stop. Files are written in whole pieces, for the
disk may be full.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import shutil
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

from runtime.errors import VisnavError

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # head of each record: opcode, length of the content
_FOOTER = struct.Struct("<BQQQI")  # with its head: begin of summary and of offsets, checksum
_IS_FOOTER, _IS_CHUNK, _IS_DATA_END, _LAST, _PRIVATE = 0x02, 0x06, 0x0F, 0x0F, 0x80
LARGEST = 1 << 29  # largest permitted size of an unpacked chunk, bytes: far above any writer's
_CHUNK = struct.Struct("<QQQII")  # first and last time, unpacked size, checksum, length of name
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"

END_WITHOUT_INDEX = (
    struct.pack("<BQI", _IS_DATA_END, 4, 0)  # no checksum
    + _FOOTER.pack(_IS_FOOTER, 20, 0, 0, 0)  # there is no summary
    + MAGIC
)


NOT_CLOSED = "the end is missing: the file was not closed"


class TornError(ValueError):
    """Nothing can be read from some place in a file on; the message says why."""


def pieces(file: IO[bytes], opcodes: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """Yield records of some opcodes up to the footer; a `TornError` if there is none."""
    for opcode, length in _heads(file):
        if opcode in opcodes:
            yield opcode, file.read(length)


def check_chunks(file: IO[bytes]) -> None:
    """Check the claimed sizes of all chunks; a `ValueError` if one is above `LARGEST`."""
    try:
        for opcode, length in _heads(file):
            if opcode == _IS_CHUNK:
                check_chunk(file.read(min(length, 128)))
    except TornError:
        pass  # the reader reports it


def check_chunk(content: bytes) -> None:
    """Check the sizes in a chunk's head and frame; a `ValueError` if above `LARGEST` or missing."""
    try:
        _, _, size, _, length = _CHUNK.unpack_from(content)
        size = max(size, frame_size(content[_CHUNK.size + length + 8 :]))
    except (struct.error, IndexError):
        raise ValueError("expected a chunk, found something else") from None
    if size > LARGEST:
        raise ValueError(f"expected a chunk of at most {LARGEST} bytes, found one of {size}")


def frame_size(data: bytes) -> int:
    """Return the size claimed by a compressed frame (RFC 8878 or LZ4), 0 if none."""
    if data.startswith(_ZSTD):
        flags = data[4]
        single = flags >> 5 & 1
        width = (single, 2, 4, 8)[flags >> 6]
        start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
        size = int.from_bytes(data[start : start + width], "little")
        return size + 256 if width == 2 else size
    if data.startswith(_LZ4) and data[4] & 8:
        return int.from_bytes(data[6:14], "little")
    return 0


def _heads(file: IO[bytes]) -> Iterator[tuple[int, int]]:
    """Yield opcode and length of each record, with the file at its content."""
    size = file.seek(0, io.SEEK_END)
    at = len(MAGIC)
    while True:
        file.seek(at)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise TornError(NOT_CLOSED)
        opcode, length = HEAD.unpack(head)
        after = at + HEAD.size + length
        if not (0 < opcode <= _LAST or opcode >= _PRIVATE) or after > size:
            raise TornError(_reason(file, at, size))
        yield opcode, length
        if opcode == _IS_FOOTER:
            return
        at = after


def piece_at(file: IO[bytes], at: int, size: int) -> bytes:
    """Return the content of a record at a position from an index.

    Args:
        size: Bytes including its head.

    Raises:
        ValueError: There is none.
    """
    file.seek(at)
    data = file.read(size)
    opcode, length = HEAD.unpack_from(data) if len(data) >= HEAD.size else (0, 0)
    if not opcode or len(data) < size or length != size - HEAD.size:
        raise ValueError(f"expected a record of {size} bytes at {at}, found something else")
    return data[HEAD.size :]


def has_summary(file: IO[bytes]) -> bool:
    """Return whether a file ends with an intact summary."""
    size = file.seek(0, io.SEEK_END)
    at = size - len(MAGIC) - _FOOTER.size
    if at < len(MAGIC):
        return False
    file.seek(at)
    footer = file.read(_FOOTER.size)
    opcode, length, start, _, checksum = _FOOTER.unpack(footer)
    if file.read() != MAGIC or (opcode, length) != (_IS_FOOTER, _FOOTER.size - HEAD.size):
        return False
    if not len(MAGIC) <= start < at:
        return False
    file.seek(start)
    summary = file.read(at - start) + footer[: -struct.calcsize("<I")]
    return checksum in {0, zlib.crc32(summary)}  # 0: its writer made none


def _reason(file: IO[bytes], at: int, size: int) -> str:
    """Return the error text for a file cut short, or damaged in the middle."""
    file.seek(-len(MAGIC), os.SEEK_END)
    if file.read() != MAGIC:
        return NOT_CLOSED
    return f"damaged: nothing can be read from byte {at} of {size} on"


class RecordingError(VisnavError):
    """A recording cannot be written or read; the message names the file and says why."""


class WholeWrites(io.BufferedIOBase):
    """File of whole pieces (all writes until `flush`): a full disk leaves no half of a chunk."""

    def __init__(self, raw: io.RawIOBase) -> None:
        self._raw = raw
        self._piece: list[bytes | bytearray] = []
        self._at = 0
        self.size = 0  # bytes of whole pieces so far

    def write(self, data: Any) -> int:
        """Add to the piece; nothing is copied, so the bytes must not change."""
        self._piece.append(data)
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the position of the next bytes."""
        return self._at

    def flush(self) -> None:
        """Write the piece, or raise an `OSError` with nothing of it in the file."""
        piece, self._piece = self._piece, []
        try:
            for data in piece:
                remaining = memoryview(data)
                while len(remaining):
                    remaining = remaining[self._raw.write(remaining) or 0 :]
        except OSError:
            self._at = self.size
            with contextlib.suppress(OSError):  # no ordinary file
                self._raw.seek(self.size)
                self._raw.truncate(self.size)
            raise
        self.size = self._at

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._raw.fileno()

    def close(self) -> None:
        """Close the file; unflushed data is discarded."""
        self._raw.close()


def open_for_writing(path: Path) -> IO[bytes]:
    """Open a file for writing, locked against other writers; an `OSError` if it cannot be."""
    file = open(  # noqa: SIM115
        path,
        "wb",
        buffering=0,
        opener=lambda name, flags: os.open(name, flags & ~os.O_TRUNC, 0o666),
    )
    if not _locked(file, fcntl.LOCK_EX):
        file.close()
        raise OSError("another process is writing it")
    with contextlib.suppress(OSError):  # no ordinary file
        file.truncate()
    return file


def is_being_written(file: IO[bytes]) -> bool:
    """Return whether a process holds a file from `open_for_writing`."""
    return not _locked(file, fcntl.LOCK_SH)


def unwritable(path: Path, error: OSError) -> RecordingError:
    """Return the error for an unwritable file, with the free disk space."""
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB free"
    except OSError:
        free = "free space unknown"
    return RecordingError(f"{path} cannot be written: {error.strerror or error} ({free})")


def _locked(file: IO[bytes], operation: int) -> bool:
    try:
        fcntl.flock(file, operation | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
