"""The writing process of a recording, as seen by the run: protocol, backlog and threads.

The loop puts events into the backlog, and waits for nothing here. One thread feeds the process,
another reads its replies. No `runtime.workers.worker.Worker`, which copies on the loop, and ends
its process soon after the run: this one outlives a killed run, or a slow disk, and closes its file.

Events go through a pipe, which a thread feeds:

i64 LE   time of publication (ns), or of the end
u32 LE   length of the frame
u8       0: an event, 1: an announcement, 2: the end
frame    of `runtime.channels.wire`
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Annotated, Literal, NamedTuple

import msgspec
import numpy as np

from events import Announcement, Event
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import Compression
from nodes.ros2.messages.typestore import Distribution
from runtime import NodeConfig
from runtime.channels.wire import Packed, pack
from runtime.errors import MissingDependencyError, WireError
from runtime.paths import OutputPath

SMALL = 512  # assumed size of an event without arrays, bytes
_LARGE = 1 << 14  # least size of an event dropped by ``drop_images``, bytes
_PAUSE = 0.005  # seconds between looks at an empty backlog: cheaper than waking at every event
_AT_ONCE = 1 << 16  # bytes handed over together
_IN_A_ROW = 16  # events in a row before the loop gets the GIL
STANDSTILL = 10.0  # real seconds without growth or other signs of life, before giving up
_LOOK = 0.5  # real seconds between checks of the process
_PIPE = 1 << 20  # size of the pipe, bytes: Linux's maximum without privileges


class Waiting(NamedTuple):
    """Queued event, with its time of publication (ns) and assumed size (bytes)."""

    time: int
    event: Event
    size: int


class Backlog:
    """Queue of event references, bounded by bytes: the loop adds, a thread pops, without locks.

    Args:
        limit: Bytes that may wait.
        when_full: What happens beyond: ``wait`` keeps everything, and `is_full` shows it;
            ``drop_images`` drops large events, and the oldest if all are small; ``drop_oldest``
            makes room.

    Attributes:
        peak: Bytes.
    """

    def __init__(self, limit: int, when_full: WhenFull) -> None:
        self.limit, self.when_full = limit, when_full
        self.dropped = self.peak = 0
        self._queue: deque[Waiting] = deque()
        # Each counter is written by one thread only, so no addition is lost.
        self._added = self._dropped_bytes = self._written = 0
        self._arrays: dict[type[Event], list[str]] = {}  # names of fields
        self._room = threading.Event()

    @property
    def bytes(self) -> int:
        """Return how many bytes wait, those being written included."""
        return self._added - self._dropped_bytes - self._written

    @property
    def is_full(self) -> bool:
        """Return whether more bytes wait than the limit."""
        return self.bytes > self.limit

    # On the loop.

    def add(self, time: int, event: Event) -> None:
        """Add an event; if the backlog is full, drop some."""
        size = self._size(event)
        waiting = self.bytes + size
        if waiting > self.limit and self.when_full != "wait":
            if self.when_full == "drop_images" and size >= _LARGE:
                self.dropped += 1
                return
            spare = self.limit // 4 if self.when_full == "drop_images" else 0
            while waiting > self.limit + spare and self._drop_oldest():
                waiting = self.bytes + size
        self.peak = max(self.peak, waiting)
        self._added += size
        self._queue.append(Waiting(time, event, size))

    def _size(self, event: Event) -> int:
        names = self._arrays.get(type(event))
        if names is None:
            values = {name: getattr(event, name) for name in event.__struct_fields__}
            names = [name for name, value in values.items() if isinstance(value, np.ndarray)]
            self._arrays[type(event)] = names
        return SMALL + sum(getattr(event, name).nbytes for name in names) if names else SMALL

    def _drop_oldest(self) -> bool:
        if (oldest := self.pop()) is None:
            return False
        self._dropped_bytes += oldest.size
        self.dropped += 1
        return True

    # In other threads.

    def pop(self) -> Waiting | None:
        """Return the oldest event, `None` if empty; call `done` after writing."""
        try:
            return self._queue.popleft()
        except IndexError:
            return None

    def done(self, waiting: Waiting) -> None:
        """Release the memory of a written event."""
        self._written += waiting.size
        if not self._room.is_set() and self.bytes <= self.limit // 2:
            self._room.set()

    def wait_for_room(self, timeout: float | None = None) -> bool:
        """Wait for half of the room, or for `release`; return False after a time-out (real s)."""
        self._room.clear()
        return self.bytes <= self.limit // 2 or self._room.wait(timeout)

    def release(self) -> None:
        """Remove the limit and wake waiting threads: nothing more is written."""
        self.limit = 1 << 62
        self._room.set()


class WriterProcess:
    """Process for writing a recording, fed from a backlog.

    Args:
        complain: Called in a thread with events that could not be recorded.

    Attributes:
        unwritten: Events that are not in the file.

    Raises:
        RecordingError: The file cannot be made.
        MissingDependencyError: A library is not installed.
    """

    def __init__(
        self,
        request: WriteRequest,
        backlog: Backlog,
        failed: Callable[[RecordingError], None],  # called in a thread, once, with the error
        complain: Callable[[str], None],
    ) -> None:
        self.path = request.path
        self.backlog = backlog
        self.error: RecordingError | None = None  # what ended the writing
        self.result = Reply("")  # the last reply of the process
        self.unwritten = self._sent = 0
        self._progress: tuple[object, ...] = ()
        self._progress_at = time.monotonic()
        self._cores = request.cores
        self._failed, self._complain = failed, complain
        self._closing = threading.Event()
        self._end = 0
        self._child = subprocess.Popen(  # noqa: S603  # our own module
            request.command(),
            bufsize=_AT_ONCE,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # so that a terminal's Ctrl-C does not reach it
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._reply_pipe, self._event_pipe = self._child.stdout, self._child.stdin
        with contextlib.suppress(OSError, AttributeError):  # elsewhere it is smaller
            fcntl.fcntl(self._event_pipe, fcntl.F_SETPIPE_SZ, _PIPE)
        first = self._read_reply()
        if first.kind != "ready":
            self._event_pipe.close()
            self._reply_pipe.close()
            self._child.wait()
            if first.kind == "missing":
                raise MissingDependencyError(first.text)
            raise RecordingError(first.text)
        self._event_thread = threading.Thread(target=self._send_all, name="recorder", daemon=True)
        self._reply_thread = threading.Thread(
            target=self._read_replies, name="recorder", daemon=True
        )

    def start(self) -> None:
        """Start both threads."""
        self._reply_thread.start()
        self._event_thread.start()

    def close(self, end: int, timeout: float | None = None) -> bool:
        """Write all queued events; return whether the file is closed. Not for a loop.

        A stopped process is continued; one without a sign of life for `STANDSTILL` seconds is
        ended, as `error` then says.

        Args:
            end: Of the run's clock, ns.
            timeout: Real seconds, after which it may be called again; `None`: as long as the disk
                takes.
        """
        self._end = end
        self._closing.set()
        with contextlib.suppress(OSError):
            self._child.send_signal(signal.SIGCONT)
        until = math.inf if timeout is None else time.monotonic() + timeout
        for thread in (self._event_thread, self._reply_thread):
            while thread.is_alive():
                if (remaining := until - time.monotonic()) <= 0.0:
                    return False
                thread.join(min(remaining, _LOOK))
                self._kill_if_stuck()
        try:
            self._child.wait(STANDSTILL)
        except subprocess.TimeoutExpired:  # it has sent its last reply
            self._child.kill()
            self._child.wait()
        if self.result.kind in {"done", "error"}:  # a killed process reports no count
            self.unwritten += self._sent - self.result.written
        return True

    def seconds_without_progress(self) -> float:
        """Return the real seconds since the process's last sign of life."""
        try:
            size = Path(self.path).stat().st_size
            fields = Path(f"/proc/{self._child.pid}/stat").read_text().rpartition(")")[2].split()
            progress = self._sent, size, fields[11], fields[12]  # with the time of its threads
        except (OSError, IndexError):  # gone, or another system
            progress = self._sent, self._child.poll()  # type: ignore[assignment]
        now = time.monotonic()
        if progress != self._progress:
            self._progress, self._progress_at = progress, now
        return now - self._progress_at

    def standstill_error(self) -> RecordingError:
        """Return the error for a process without a sign of life."""
        return RecordingError(
            f"{self.path}: the process that writes it ({self._child.pid}) has taken nothing for "
            f"{STANDSTILL:g} s; what it had taken is kept"
        )

    def _kill_if_stuck(self) -> None:
        if self.seconds_without_progress() >= STANDSTILL and self._child.poll() is None:
            self.error = self.standstill_error()
            self._child.kill()

    # In the thread that sends events.

    def _send_all(self) -> None:
        # Off the busy cores: scheduled out there with Python's lock, this thread would block the
        # loop.
        if self._cores and (spare := os.sched_getaffinity(0) - {*self._cores}):
            os.sched_setaffinity(0, spare)
        try:
            self._send_events()
            write(self._event_pipe, self._end, END)
            self._event_pipe.flush()
        except (OSError, ValueError):
            pass  # the process is gone, or its pipe is closed: the other thread reads why
        finally:
            with contextlib.suppress(OSError):
                self._event_pipe.close()
            self.backlog.release()
        closed = False
        while not closed:
            closed = self._closing.wait(_PAUSE)
            while (waiting := self.backlog.pop()) is not None:
                self.unwritten += 1
                self.backlog.done(waiting)

    def _send_events(self) -> None:
        unfinished: list[Waiting] = []
        try:
            while True:
                closing = self._closing.is_set()  # read before the queue, so no event is missed
                if (waiting := self.backlog.pop()) is not None:
                    unfinished.append(waiting)
                    self._write(waiting)
                    if (
                        sum(entry.size for entry in unfinished) < _AT_ONCE
                        and len(unfinished) < _IN_A_ROW
                    ):
                        continue
                if unfinished:
                    self._event_pipe.flush()
                    self._sent += len(unfinished)
                    for entry in unfinished:
                        self.backlog.done(entry)
                    unfinished = []
                elif closing:
                    return
                else:
                    self._closing.wait(_PAUSE)
        except (OSError, ValueError):
            self.unwritten += len(unfinished)
            raise

    def _write(self, waiting: Waiting) -> None:
        is_announced = isinstance(waiting.event, Announcement)
        try:
            packed = pack(waiting.event)
        except WireError as error:
            self._complain(str(error))
            return
        write(self._event_pipe, waiting.time, ANNOUNCEMENT if is_announced else EVENT, packed)

    # In the thread that reads replies.

    def _read_replies(self) -> None:
        while (reply := self._read_reply()).kind == "complaint":
            self._complain(reply.text)
        self._reply_pipe.close()
        self.result = reply
        if reply.kind != "done":
            self.error = self.error or RecordingError(reply.text)
            self._failed(self.error)

    def _read_reply(self) -> Reply:
        line = self._reply_pipe.readline()
        try:
            return msgspec.json.decode(line, type=Reply)
        except msgspec.DecodeError:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(1.0)
            code = self._child.returncode
            return Reply("gone", f"{self.path}: the process that writes it ended with {code}")


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
    kind: str
    text: str = ""
    written: int = 0
    size: int = 0  # bytes of the file


EVENT, ANNOUNCEMENT, END = 0, 1, 2
_HEAD = struct.Struct("<qIB")
_PART = 1 << 16  # bytes written at once: the kernel does not release the core meanwhile


class Piece(NamedTuple):
    """Unit of the pipe: an event, an announcement, or the end."""

    time: int
    kind: int
    frame: bytearray


def write(file: IO[bytes], time: int, kind: int, event: Packed | None = None) -> None:
    """Write a piece to a buffered pipe, without the GIL; an `OSError` if the reader is gone."""
    file.write(_HEAD.pack(time, 0 if event is None else event.size, kind))
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
        time, length, kind = _HEAD.unpack(head)
        frame = _read(file, length)
        if len(frame) < length:
            return
        yield Piece(time, kind, frame)


def _read(file: int, size: int) -> bytearray:
    """Return as many bytes, or fewer at the end."""
    buffer = bytearray(size)
    view, received = memoryview(buffer), 0
    while received < size and (count := os.readv(file, [view[received:]])):
        received += count
    return bytearray(view[:received]) if received < size else buffer
