"""What a run and the process that writes for it send each other: a request, replies, events.

Events go through a pipe, which a thread feeds:

i64 LE   time of publication (ns), or of the end
u32 LE   length of the frame
u8       0: an event, 1: an announcement, 2: the end
frame    of `runtime.wire`

What waits to be written, bounded by bytes: one thread puts, another takes, and neither locks.

References only: putting an event copies and encodes nothing.

The recorder's settings in a run's file.
"""

from __future__ import annotations

import os
import select
import struct
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from typing_extensions import Buffer

from events import Event
from nodes.data.mcap.mcap_file import Compression
from nodes.ros2.messages.typestore import Distribution
from runtime import NodeConfig
from runtime.paths import OutputPath
from runtime.wire import Packed

WhenFull = Literal["wait", "drop_images", "drop_oldest"]

SMALL = 512
"""Bytes that an event without arrays is reckoned at."""

_LARGE = 1 << 14
"""Bytes from which an event is one of those that ``drop_images`` drops."""


class Waiting(NamedTuple):
    """An event that waits.

    Attributes:
        time: When it was published (ns).
        event: The event.
        size: Bytes that it is reckoned at.
    """

    time: int
    event: Event
    size: int


class Backlog:
    """A queue between the loop and the thread that writes.

    Args:
        limit: Bytes that may wait.
        when_full: What happens beyond: ``wait`` keeps everything, and `is_full` shows it;
            ``drop_images`` drops what is large, and the oldest only if there is nothing but small
            events; ``drop_oldest`` makes room, whatever it costs.
    """

    def __init__(self, limit: int, when_full: WhenFull) -> None:
        self.limit = limit
        self.when_full = when_full
        self.dropped = 0
        """Events."""
        self.peak = 0
        """Bytes."""
        self._queue: deque[Waiting] = deque()
        # One counter for each side, so that no addition is ever lost between the two.
        self._put = 0
        self._dropped_bytes = 0
        self._written = 0
        self._sizes: dict[type[Event], Callable[[Event], int]] = {}
        self._room = threading.Event()

    @property
    def bytes(self) -> int:
        """Return how many bytes wait, those being written included."""
        return self._put - self._dropped_bytes - self._written

    @property
    def is_full(self) -> bool:
        """Tell whether more waits than should."""
        return self.bytes > self.limit

    # On the loop.

    def put(self, time: int, event: Event) -> None:
        """Add an event, or drop one."""
        kind = type(event)
        size_of = self._sizes.get(kind)
        if size_of is None:
            size_of = self._sizes[kind] = _size_of(event)
        size = size_of(event)
        waiting = self._put - self._dropped_bytes - self._written + size
        if waiting > self.limit and self.when_full != "wait":
            if self.when_full == "drop_images" and size >= _LARGE:
                self.dropped += 1
                return
            spare = self.limit // 4 if self.when_full == "drop_images" else 0
            while waiting > self.limit + spare and self._drop_oldest():
                waiting = self.bytes + size
        if waiting > self.peak:
            self.peak = waiting
        self._put += size
        self._queue.append(Waiting(time, event, size))

    def _drop_oldest(self) -> bool:
        try:
            oldest = self._queue.popleft()
        except IndexError:
            return False
        self._dropped_bytes += oldest.size
        self.dropped += 1
        return True

    # In other threads.

    def take(self) -> Waiting | None:
        """Return the oldest; `None` if nothing waits. Call `done` when it is written."""
        try:
            return self._queue.popleft()
        except IndexError:
            return None

    def done(self, waiting: Waiting) -> None:
        """Note that an event is written, and needs no memory any more."""
        self._written += waiting.size
        if not self._room.is_set() and self.bytes <= self.limit // 2:
            self._room.set()

    def wait_for_room(self, timeout: float | None = None) -> bool:
        """Wait until half of the room is free, or `release` is called; tell whether that came.

        Args:
            timeout: Real seconds to wait at most.
        """
        self._room.clear()
        return self.bytes <= self.limit // 2 or self._room.wait(timeout)

    def release(self) -> None:
        """Let go of whoever waits: nothing will be written any more."""
        self.limit = 1 << 62
        self._room.set()


def _size_of(event: Event) -> Callable[[Event], int]:
    """Return a function that tells the size of events of this type."""
    arrays = [
        name for name in event.__struct_fields__ if isinstance(getattr(event, name), np.ndarray)
    ]
    if not arrays:
        return _small

    def size(of: Any) -> int:
        content: int = sum(getattr(of, name).nbytes for name in arrays)
        return SMALL + content

    return size


def _small(_: Event) -> int:
    return SMALL


Bytes = Annotated[int, msgspec.Meta(ge=1 << 16)]
ChunkBytes = Annotated[int, msgspec.Meta(ge=1 << 16, le=1 << 28)]


class McapRecorderConfig(NodeConfig):
    """Settings of a recording.

    Attributes:
        file: Its name in the run's folder. An older one is replaced.
        image_format: How images are kept: ``raw``, ``png`` (smaller, and no loss), or
            ``jpeg`` (small; a replay gives what is left).
        depth_format: How depth images are kept: ``raw``, or ``png``: whole millimetres, up to 65 m.
        jpeg_quality: 1 to 100.
        compression: Of the file's chunks: ``zstd``, ``lz4`` (quicker, larger) or ``none``.
        chunk_size: Bytes of a chunk before compression. A chunk also ends 0.4 s after its
            first event, real or on the run's clock.
        memory: Bytes of events that may wait to be written.
        when_full: What happens if more would wait. ``wait``: simulated time waits for the disk;
            real time cannot, and does as ``drop_images``: images and clouds are left out until
            there is room. A process that shows no sign of life for 10 s while it is waited for
            ends the run. ``drop_oldest``: what has waited longest is left out. What is left out
            is counted among the run's drops, and logged. What the disk has not taken when the run
            ends is written afterwards, before the command returns.
        fsync: Wait for the disk at the end of each chunk. Without it, what is written survives
            the end of the process, but not a power cut.
        distribution: Of ROS 2, whose types the messages have.
    """

    file: Annotated[OutputPath, msgspec.Meta(pattern=r"^[^/]+\.mcap$")] = "recording.mcap"
    image_format: Literal["raw", "png", "jpeg"] = "raw"
    depth_format: Literal["raw", "png"] = "raw"
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    compression: Compression = "zstd"
    chunk_size: ChunkBytes = 4 << 20
    memory: Bytes = 256 << 20
    when_full: WhenFull = "wait"
    fsync: bool = False
    distribution: Distribution = "jazzy"


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
