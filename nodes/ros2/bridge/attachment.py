"""What goes with every message: its number, when it was sent, and by whom.

A ROS process that gets a malformed attachment ends, so there is one place that makes them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import xxhash

_LAYOUT = struct.Struct("<qqB16s")
"""Two numbers, and a buffer of 16 bytes after its length, in Zenoh's own serialisation."""

SIZE = _LAYOUT.size


class Attachment(NamedTuple):
    """What an attachment says.

    Attributes:
        sequence: Number of the message from its publisher, from 1.
        stamp: Wall clock, nanoseconds since 1970.
        gid: The 16 bytes by which ROS tells one publisher from another.
    """

    sequence: int
    stamp: int
    gid: bytes


class Message(NamedTuple):
    """A message that has come; its bytes are not copied before they are asked for.

    Attributes:
        size: Bytes.
        read: Returns them.
        attached: Returns what becomes those of its attachment, if there is one.
    """

    size: int
    read: Callable[[], bytes]
    attached: Callable[[], Any] = bytes

    @property
    def attachment(self) -> Attachment | None:
        """Return its attachment; ``None`` if there is none, or what came is none."""
        try:
            return unpack(bytes(self.attached() or b""))
        except ValueError:
            return None


def gid(token: str) -> bytes:
    """Return the GID of the owner of a liveliness token, as rmw_zenoh_cpp makes it.

    It is the token's XXH3 hash of 128 bits, its low 64 bits first, little endian.
    """
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def pack(attachment: Attachment) -> bytes:
    """Return the attachment's 33 bytes.

    Raises:
        ValueError: The GID has not 16 bytes.
    """
    if len(attachment.gid) != 16:
        raise ValueError(f"gid: expected 16 bytes, found {len(attachment.gid)}")
    return _LAYOUT.pack(attachment.sequence, attachment.stamp, 16, attachment.gid)


def unpack(data: bytes) -> Attachment:
    """Read an attachment.

    Raises:
        ValueError: It is none.
    """
    if len(data) != SIZE or data[16] != 16:
        raise ValueError(f"attachment: expected {SIZE} bytes with a GID of 16, found {data!r:.80}")
    sequence, stamp, _, gid = _LAYOUT.unpack(data)
    return Attachment(sequence, stamp, gid)
