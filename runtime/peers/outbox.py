"""The way to one other process: a message goes at once if it is sure to, else by a thread.

Zenoh waits where the network is slow, and the loop must not. A small message goes out on the spot
as long as little is under way, by what the other process has confirmed; then Zenoh has room for
it. So does an image if the other process sees memory of ours, where it is put: its message is
small. All others are written by a thread, in order.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable

import msgspec

from events import Event
from runtime.errors import ChannelFullError, PeerError, VisnavError
from runtime.peers.messages import Message, encode
from runtime.peers.shared_memory import Outgoing
from runtime.wire import Packed, pack

Put = Callable[[bytes, bytes], None]

BOUND = 1024
"""Events that may wait for the network: as many as an input keeps."""

SMALL = 8192
"""Bytes of a message that the loop may write itself: copying them takes a microsecond."""

AT_ONCE = 1 << 20
"""Bytes of an event that the loop may put into common memory: copying them takes 0.1 ms."""

UNDER_WAY = 32768
"""Bytes that may be under way for that: Zenoh's queue holds four times as many."""


class Outbox:
    """Messages on their way to one process, in order.

    Args:
        name: Of the process, for messages to people.
        put: Writes one; may wait.
        failed: Called, in the outbox's thread, with why something could not be sent.

    Attributes:
        replaced: Events that a newer one of the same output took the place of.
        peak: Most messages that ever waited.
        memory: That the other process sees, once it has confirmed it.
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
        self._lock = threading.RLock()
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._closed = False
        self._thread: threading.Thread | None = None

    def send(self, message: Message, event: Event | None = None, skip: str = "") -> None:
        """Send a message, or put it at the end of those that wait.

        Args:
            message: What to send.
            event: Goes with it.
            skip: If given, the event takes the place of one with the same word that still waits.

        Raises:
            WireError: The event cannot be made into bytes.
            ChannelFullError: Too many events wait already, and this one may not replace one.
        """
        packed = None if event is None else pack(event)
        with self._lock:
            if self._closed:
                return
            before = self._skippable.get(skip)
            if before is not None:
                before.packed = packed
                self.replaced += 1
            elif self._idle() and (parts := self._in_bytes(message, packed, now=True)):
                self._put_now(*parts)
            else:
                self._wait(_Waiting(message, packed, skip))

    def arrived(self, count: int) -> None:
        """Take in how many bytes have arrived at the other end."""
        with self._lock:
            self._under_way = max(self._under_way - count, 0)

    def close(self, timeout: float = 2.0) -> None:
        """Write what waits, for so many seconds at most, and end."""
        with self._lock:
            self._closed = True
            self._wake.put(None)
        if self._thread is not None:
            self._thread.join(timeout)

    def abandon(self) -> None:
        """Write no more: the process has gone."""
        with self._lock:
            self._queue.clear()
            self._closed = True
            self._wake.put(None)

    def _idle(self) -> bool:
        return not (self._queue or self._writing) and self._under_way < UNDER_WAY

    def _in_bytes(
        self, message: Message, packed: Packed | None, *, now: bool
    ) -> tuple[bytes, bytes] | None:
        """Return a message and its payload; `None` if making them takes too long to do it now."""
        if packed is None or packed.size <= SMALL:
            return encode(message), b"" if packed is None else packed.frame()
        if self.memory is not None and not (now and packed.size > AT_ONCE):
            place = self.memory.put(packed)
            if place is not None:
                return encode(msgspec.structs.replace(message, place=place)), b""
        return None if now else (encode(message), packed.frame())

    def _put_now(self, head: bytes, frame: bytes) -> None:
        with self._lock:
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
        self._wake.put(None)
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name=f"to {self.name}", daemon=True)
            self._thread.start()

    def _write(self) -> None:
        while True:
            self._wake.get()
            with self._lock:
                if not self._queue:
                    if self._closed:
                        return
                    continue
                waiting = self._queue.popleft()
                self._writing = True
                self._skippable.pop(waiting.skip, None)
                if waiting.packed is not None:
                    self._events -= 1
            try:
                parts = self._in_bytes(waiting.message, waiting.packed, now=False)
                assert parts is not None
            except Exception as error:  # the message goes without its event: others count it
                parts = encode(waiting.message), b""
                self._failed(PeerError(f"an event could not be sent: {_describe(error)}"))
            self._put_now(*parts)
            self._writing = False
            if self._closed:
                self._wake.put(None)  # look again whether anything is left


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


class _Waiting:
    """One message in the outbox."""

    __slots__ = ("message", "packed", "skip")

    def __init__(self, message: Message, packed: Packed | None, skip: str) -> None:
        self.message = message
        self.packed = packed
        self.skip = skip
