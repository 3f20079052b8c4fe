"""What a run and the process that writes for it send each other: a request, replies, events.

Events go through a pipe, which a thread feeds:

i64 LE   time of publication (ns), or of the end
u32 LE   length of the frame
u8       0: an event, 1: an announcement, 2: the end
frame    of `runtime.wire`
"""

from __future__ import annotations

import os
import select
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from typing_extensions import Buffer

from nodes.data.recorder.settings import McapRecorderConfig
from runtime.wire import Packed


class WriteRequest(msgspec.Struct, frozen=True):
    """A file to write, and how.

    Attributes:
        path: The file to write.
        config: The recorder's settings.
        attachment: A file to add, if it is there.
        niceness: How much to stand back for others.
        cores: To run on; all if empty.
        metadata: The file beside it that makes a bag of ROS 2 of their folder; none if empty.
    """

    path: str
    config: McapRecorderConfig
    attachment: str
    niceness: int
    cores: tuple[int, ...]
    metadata: str = ""


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line that the process sends.

    Attributes:
        what: ``ready``, ``complaint``, ``error``, ``missing`` (a library) or ``done``;
            ``gone`` stands for a process that ended without a reply.
        text: For messages.
        written: Events in the file.
        size: Bytes of the file.
    """

    what: str
    text: str = ""
    written: int = 0
    size: int = 0


def command(request: WriteRequest) -> list[str]:
    """Return the command that starts such a process."""
    text = msgspec.json.encode(request).decode()
    return [sys.executable, "-m", "nodes.data.recorder.process", text]


EVENT, ANNOUNCEMENT, END = 0, 1, 2

_HEAD = struct.Struct("<qIB")
_LENGTH = struct.Struct("<I")
_PART = 1 << 16
"""Bytes written at once: the kernel does not let go of the core meanwhile, and the loop may need
it."""

_MOST = 512
"""Buffers of a call of writev(2), which takes 1024."""


class Piece(NamedTuple):
    """What comes out of the pipe."""

    time: int
    what: int
    frame: bytearray


def pieces(time: int, packed: Packed, what: int) -> list[Buffer]:
    """Return the bytes of an event, as buffers, none of them copied."""
    head = _LENGTH.pack(len(packed.head)) + packed.head
    found: list[Buffer] = [_HEAD.pack(time, packed.size, what) + head]
    at = len(head)
    for array, offset in zip(packed.arrays, packed.offsets, strict=True):
        if offset > at:
            found.append(bytes(offset - at))
        if array.nbytes:
            found.append(array.reshape(-1).view(np.uint8).data)
        at = offset + array.nbytes
    if packed.size > at:
        found.append(bytes(packed.size - at))
    return found


def end(time: int) -> bytes:
    """Return what ends the pipe in order."""
    return _HEAD.pack(time, 0, END)


def write_all(file: int, buffers: Sequence[Buffer]) -> None:
    """Write buffers to a file descriptor, waiting as long as it takes; Python's lock is free.

    Raises:
        OSError: Nobody reads any more.
    """
    views = [part for buffer in buffers for part in _parts(memoryview(buffer).cast("B"))]
    while views:
        written = os.writev(file, views[:1] if len(views[0]) == _PART else _some(views))
        while views and written >= len(views[0]):
            written -= len(views.pop(0))
        if written:
            views[0] = views[0][written:]


def _parts(view: memoryview) -> list[memoryview]:
    return [view[at : at + _PART] for at in range(0, len(view), _PART)]


def _some(views: list[memoryview]) -> list[memoryview]:
    """Return the views before the next large part."""
    large = (n for n, view in enumerate(views[:_MOST]) if len(view) == _PART)
    return views[: next(large, _MOST)]


def read_all(file: int, idle: float, while_idle: Callable[[], None]) -> Iterator[Piece]:
    """Yield what comes, up to the end of the pipe; half a piece at its end is left out.

    Args:
        file: The descriptor to read.
        idle: Seconds without anything after which `while_idle` is called, again and again.
        while_idle: See `idle`.
    """
    while True:
        while not select.select([file], [], [], idle)[0]:
            while_idle()
        head = _read(file, _HEAD.size)
        if len(head) < _HEAD.size:
            return
        time, length, what = _HEAD.unpack(head)
        frame = _read(file, length)
        if len(frame) < length:
            return
        yield Piece(time, what, frame)


def _read(file: int, size: int) -> bytearray:
    """Return as many bytes, or fewer at the end."""
    buffer = bytearray(size)
    view, got = memoryview(buffer), 0
    while got < size:
        count = os.readv(file, [view[got:]])
        if count == 0:
            return bytearray(view[:got])
        got += count
    return buffer
