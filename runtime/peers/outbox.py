"""Outbox of messages to another process, and memory in common with it for large events.

Zenoh waits where the network is slow, and the loop must not. A small message goes out on the spot
as long as little is under way, by what the other process has confirmed; then Zenoh has room for
it. So does an image if the other process sees memory of ours, where it is put: its message is
small. All others are written by a thread, in order.

Of memory, a process offers the other a nameless file, by its path in ``/proc`` and a key at its
beginning. A process that can open the file and finds the key is on the same machine, and reads
frames in place; the others get them over the network. A block is used again once the last array on
it is gone. The file cannot shrink: mapped memory stays readable, whatever its owner does.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import secrets
import stat
import threading
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from events import Event
from runtime.errors import ChannelFullError, PeerError, VisnavError, WireError
from runtime.peers import messages
from runtime.wire import Packed, pack
from runtime.workers.shared_memory import Arena, MappedFile, anonymous_file

log = logging.getLogger("visnav.runtime")

Put = Callable[[bytes, bytes], None]

BOUND = 1024  # most events waiting for the network: as many as an input keeps
SMALL = 8192  # most bytes of a message written by the loop itself: copying takes a microsecond
AT_ONCE = 1 << 20  # most bytes of an event put into common memory by the loop: copying takes 0.1 ms
CLOSING = 2.0  # most seconds for what waits to be written, at the end

UNDER_WAY = 32768
"""Most unconfirmed bytes for writing at once; Zenoh's queue holds four times as many."""

LIMIT = 1 << 28  # most bytes of a file; events without room cross the network
KEY = 32


class Outbox:
    """Messages on their way to a process, in order.

    Args:
        put: Writes one; may wait.
        failed: Called, in the outbox's thread, with the error of a failed write.

    Attributes:
        replaced: Number of events replaced by a newer one of the same output.
        memory: Shared with the other process, once confirmed.
    """

    def __init__(self, name: str, put: Put, failed: Callable[[VisnavError], None]) -> None:
        self.name = name
        self.replaced = 0
        self.peak = 0
        self.memory: Outgoing | None = None
        self._put = put
        self._failed = failed
        self._queue: deque[_Waiting] = deque()
        self._skippable: dict[str, _Waiting] = {}
        self._events = 0
        self._under_way = 0
        self._writing = False
        self._closed = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def send(self, message: messages.Message, event: Event | None = None, skip: str = "") -> None:
        """Send a message now, or queue behind the waiting messages.

        Args:
            skip: If given, the event takes the place of one with the same word that still waits.

        Raises:
            WireError: The event cannot be made into bytes.
            ChannelFullError: Too many events wait already, and this one may not replace one.
        """
        packed = None if event is None else pack(event)
        with self._changed:
            if self._closed:
                return
            idle = not (self._queue or self._writing) and self._under_way < UNDER_WAY
            before = self._skippable.get(skip)
            if before is not None:
                before.packed = packed
                self.replaced += 1
            elif idle and (parts := self._in_bytes(message, packed, now=True)):
                self._put_now(*parts)
            else:
                self._wait(_Waiting(message, packed, skip))

    def arrived(self, count: int) -> None:
        """Take in how many bytes have arrived at the other end."""
        with self._changed:
            self._under_way = max(self._under_way - count, 0)

    def close(self) -> None:
        """Write the waiting messages, for at most `CLOSING` seconds, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(CLOSING)

    def abandon(self) -> None:
        """Write no more: the process has gone."""
        with self._changed:
            self._queue.clear()
            self._closed = True
            self._changed.notify()

    def _in_bytes(
        self, message: messages.Message, packed: Packed | None, *, now: bool
    ) -> tuple[bytes, bytes] | None:
        """Return a message and its payload; `None` if making them takes too long for now."""
        if packed is None or packed.size <= SMALL:
            return messages.encode(message), b"" if packed is None else packed.frame()
        if self.memory is not None and not (now and packed.size > AT_ONCE):
            place = self.memory.put(packed)
            if place is not None:
                return messages.encode(msgspec.structs.replace(message, place=place)), b""
        return None if now else (messages.encode(message), packed.frame())

    def _put_now(self, head: bytes, frame: bytes) -> None:
        with self._changed:
            self._under_way += len(head) + len(frame)
        try:
            self._put(head, frame)
        except VisnavError as error:
            self._failed(error)
        except Exception as error:  # whatever a library does, the outbox goes on
            self._failed(PeerError(f"a message could not be sent: {_describe(error)}"))

    def _wait(self, waiting: _Waiting) -> None:
        if waiting.packed is not None:
            if self._events >= BOUND:
                raise ChannelFullError(
                    f"expected room for one more event to {self.name}, found {BOUND} that wait "
                    'for the network: send less, or read them with keep="latest" there'
                )
            self._events += 1
        self._queue.append(waiting)
        if waiting.skip:
            self._skippable[waiting.skip] = waiting
        self.peak = max(self.peak, len(self._queue))
        self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name=f"to {self.name}", daemon=True)
            self._thread.start()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closed)
                if not self._queue:
                    return
                waiting = self._queue.popleft()
                self._writing = True
                self._skippable.pop(waiting.skip, None)
                self._events -= waiting.packed is not None
            try:
                parts = self._in_bytes(waiting.message, waiting.packed, now=False)
                assert parts is not None
            except Exception as error:  # the message goes without its event: others count it
                parts = messages.encode(waiting.message), b""
                self._failed(PeerError(f"an event could not be sent: {_describe(error)}"))
            self._put_now(*parts)
            self._writing = False


@dataclass(slots=True)
class _Waiting:
    message: messages.Message
    packed: Packed | None
    skip: str


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


class Outgoing:
    """Memory written by this process, with large events for another; closed with this object.

    `put` is called by one thread at a time.

    Attributes:
        freed: Places of frames read no more by the other process; appended to from any thread.
    """

    def __init__(self) -> None:
        self._fd = anonymous_file()
        self._arena = Arena(self._fd, LIMIT)
        weakref.finalize(self, self._arena.close)
        self._key = secrets.token_bytes(KEY)
        self._arena.put(memoryview(self._key))
        self.freed: deque[int] = deque()

    def offer(self) -> messages.MemoryOffer:
        """Return the offer of this memory to the other process."""
        return messages.MemoryOffer(
            machine=machine(), path=f"/proc/{os.getpid()}/fd/{self._fd}", key=self._key
        )

    def put(self, packed: Packed) -> tuple[int, int] | None:
        """Put a frame there, and return its place and size; `None` if there is no room."""
        while self.freed:
            if offset := self.freed.popleft():  # the key stays at 0
                self._arena.free(offset)
        place = self._arena.reserve(packed.size)
        if place is None:
            return None
        packed.write(self._arena.view(place, packed.size))
        return place, packed.size


class Incoming(MappedFile):
    """Memory written by another process, with large events for this process.

    The file is closed with this object; arrays that stand in it stay valid.
    """

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        weakref.finalize(self, os.close, fd)

    @classmethod
    def found(cls, offer: messages.MemoryOffer) -> Incoming | None:
        """Return the offered memory; `None` if not accessible from here."""
        here = offer.machine and offer.machine == machine()
        if not (here and re.fullmatch(r"/proc/\d+/fd/\d+", offer.path)):
            return None
        try:
            fd = os.open(offer.path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            log.debug("no memory in common: %s", error)
            return None
        try:
            fits = (
                stat.S_ISREG(os.fstat(fd).st_mode)
                and fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
                and secrets.compare_digest(os.pread(fd, KEY, 0), offer.key)
            )
        except OSError:
            fits = False
        if not fits:
            os.close(fd)
            log.debug("no memory in common: %s is another file", offer.path)
            return None
        return cls(fd)

    def frame(self, offset: int, size: int) -> memoryview:
        """Return a frame in place, without a copy; raise `WireError` if there is none."""
        try:
            block = self.view(offset, size)
        except (OSError, ValueError) as error:
            text = f"expected {size} bytes of common memory at {offset}, found: {error}"
            raise WireError(text) from None
        return np.frombuffer(block, np.uint8).data


def machine() -> str:
    """Return the boot id, common to the processes of a machine; "" if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""
