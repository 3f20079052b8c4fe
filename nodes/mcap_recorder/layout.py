"""The bytes of an MCAP file from outside: its records, and whether its index can be trusted.

Needs no mcap. Of the format (mcap.dev/spec) no more stands here than what finds the records of a
file that may be torn or damaged anywhere; what is in them is for `mcap_file`.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from typing import IO

MAGIC = b"\x89MCAP0\r\n"

HEAD = struct.Struct("<BQ")
"""Before each record: what it is, and how long."""

_FOOTER = struct.Struct("<BQQQI")
"""With its head: where the summary begins, where its offsets do, checksum of the summary."""

_IS_FOOTER, _IS_DATA_END, _LAST, _PRIVATE = 0x02, 0x0F, 0x0F, 0x80

END_WITHOUT_INDEX = (
    struct.pack("<BQI", _IS_DATA_END, 4, 0)  # no checksum
    + _FOOTER.pack(_IS_FOOTER, 20, 0, 0, 0)  # there is no summary
    + MAGIC
)


class TornError(ValueError):
    """Nothing can be read from some place in a file on; the message says why."""


def pieces(file: IO[bytes], wanted: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """Yield the records of a file that are of some kinds (opcodes), up to its footer.

    Raises:
        TornError: There is no footer, or something else than a record before it.
    """
    size = file.seek(0, io.SEEK_END)
    at = len(MAGIC)
    while True:
        file.seek(at)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise TornError("the end is missing: the file was not closed")
        opcode, length = HEAD.unpack(head)
        after = at + HEAD.size + length
        if not (0 < opcode <= _LAST or opcode >= _PRIVATE) or after > size:
            raise TornError(_why(file, at, size))
        if opcode in wanted:
            yield opcode, file.read(length)
        if opcode == _IS_FOOTER:
            return
        at = after


def piece_at(file: IO[bytes], at: int, size: int) -> bytes:
    """Return the content of the record at a place, where an index says that there is one.

    Args:
        file: The file.
        at: Where it begins.
        size: Its bytes, with those before its content.

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
    """Tell whether a file ends with a summary that is as it was written."""
    size = file.seek(0, io.SEEK_END)
    at = size - len(MAGIC) - _FOOTER.size
    if at < len(MAGIC):
        return False
    file.seek(at)
    footer = file.read(_FOOTER.size)
    opcode, length, begin, _, checksum = _FOOTER.unpack(footer)
    if file.read() != MAGIC or (opcode, length) != (_IS_FOOTER, _FOOTER.size - HEAD.size):
        return False
    if not len(MAGIC) <= begin < at:
        return False
    file.seek(begin)
    summary = file.read(at - begin) + footer[: -struct.calcsize("<I")]
    return checksum in {0, zlib.crc32(summary)}  # 0: its writer made none


def _why(file: IO[bytes], at: int, size: int) -> str:
    """Tell a file that ends too early from one that is damaged in the middle."""
    file.seek(-len(MAGIC), os.SEEK_END)
    if file.read() != MAGIC:
        return "the end is missing: the file was not closed"
    return f"damaged: nothing can be read from byte {at} of {size} on"
