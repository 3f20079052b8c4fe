"""Protocol of a run and its writing process: a request, replies, events.

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
from collections.abc import Callable, Iterator
from typing import IO, Annotated, Literal, NamedTuple

import msgspec

from nodes.data.mcap.mcap_file import Compression
from nodes.ros2.messages.typestore import Distribution
from runtime import NodeConfig
from runtime.paths import OutputPath
from runtime.wire import Packed

WhenFull = Literal["wait", "drop_images", "drop_oldest"]
Bytes = Annotated[int, msgspec.Meta(ge=1 << 16)]
ChunkBytes = Annotated[int, msgspec.Meta(ge=1 << 16, le=1 << 28)]


class McapRecorderConfig(NodeConfig):
    """Settings of a recording.

    Attributes:
        file: Its name in the run's folder; replaces an older file.
        image_format: How images are kept: ``raw``, ``png`` (smaller, and no loss), or ``jpeg``
            (small, with loss).
        depth_format: How depth images are kept: ``raw``, or ``png``: whole millimetres, up to 65 m.
        jpeg_quality: 1 to 100.
        compression: Of the file's chunks: ``zstd``, ``lz4`` (quicker, larger) or ``none``.
        chunk_size: Bytes of a chunk before compression. A chunk also ends 0.4 s after its first
            event, real or on the run's clock.
        memory: Bytes of events that may wait to be written.
        when_full: What happens beyond. ``wait``: simulated time waits for the disk (a process
            without a sign of life for 10 s ends the run); real time cannot, and does as
            ``drop_images``: images and clouds are left out until there is room. ``drop_oldest``:
            the oldest events are left out. Drops are counted and logged. The remainder at the run's
            end is written before the command returns.
        fsync: Wait for the disk at the end of each chunk. Without it, data survives the process,
            but not a power cut.
        distribution: Of ROS 2, for the messages' types.
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
    """A file to write, and how."""

    path: str
    config: McapRecorderConfig = McapRecorderConfig()
    attachment: str = ""  # a file to add, if it is there
    niceness: int = 0  # of the process, as of nice(1)
    cores: tuple[int, ...] = ()  # to run on; all if empty
    metadata: str = ""  # file beside it that makes their folder a bag of ROS 2; none if empty

    def command(self) -> list[str]:
        """Return the command to start the writing process."""
        text = msgspec.json.encode(self).decode()
        return [sys.executable, "-m", "nodes.data.recorder.process", text]


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """Line sent by the writing process."""

    # ``ready``, ``complaint``, ``error``, ``missing`` (a library) or ``done``; ``gone`` stands for
    # a process that ended without a reply.
    what: str
    text: str = ""
    written: int = 0
    size: int = 0  # bytes of the file


EVENT, ANNOUNCEMENT, END = 0, 1, 2
_HEAD = struct.Struct("<qIB")
_PART = 1 << 16  # bytes written at once: the kernel does not let go of the core meanwhile


class Piece(NamedTuple):
    """Unit of the pipe: an event, an announcement, or the end."""

    time: int
    what: int
    frame: bytearray


def write(file: IO[bytes], time: int, what: int, event: Packed | None = None) -> None:
    """Write a piece to a buffered pipe, without the GIL; an `OSError` if the reader is gone."""
    file.write(_HEAD.pack(time, 0 if event is None else event.size, what))
    for part in () if event is None else event.parts():
        view = memoryview(part)
        for at in range(0, len(view), _PART):
            file.write(view[at : at + _PART])


def read_all(file: int, idle: float, while_idle: Callable[[], None]) -> Iterator[Piece]:
    """Yield pieces to the end of the pipe; call `while_idle` after `idle` seconds of silence."""
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
    while got < size and (count := os.readv(file, [view[got:]])):
        got += count
    return bytearray(view[:got]) if got < size else buffer
