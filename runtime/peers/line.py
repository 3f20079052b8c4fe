"""A thread that writes to one other process, so that the loop never waits for a network."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from events import Event
from runtime.errors import ChannelFullError, VisnavError
from runtime.peers.messages import Message, encode
from runtime.wire import pack

Put = Callable[[bytes, bytes | bytearray], None]

BOUND = 1024
"""Events that may wait for the network: as many as an input keeps."""


class Line:
    """Messages on their way to one process, in order.

    Args:
        name: Of the process, for messages to people.
        put: Writes one; may wait.
        failed: Told, in the line's thread, why something could not be sent.

    Attributes:
        replaced: Events that a newer one of the same output took the place of.
        peak: Most messages that ever waited.
    """

    def __init__(self, name: str, put: Put, failed: Callable[[VisnavError], None]) -> None:
        self.name = name
        self.replaced = 0
        self.peak = 0
        self._put = put
        self._failed = failed
        self._queue: deque[_Waiting] = deque()
        self._skippable: dict[str, _Waiting] = {}
        self._events = 0
        self._something = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._write, name=f"to {name}", daemon=True)
        self._thread.start()

    def send(self, message: Message, event: Event | None = None, skip: str = "") -> None:
        """Put a message at the end of the line.

        Args:
            message: What to say.
            event: Goes with it.
            skip: If given, the event takes the place of one with the same word that still waits.

        Raises:
            ChannelFullError: Too many events wait already, and this one may not replace one.
        """
        with self._something:
            before = self._skippable.get(skip)
            if before is not None:
                before.event = event
                self.replaced += 1
                return
            if event is not None:
                if self._events >= BOUND:
                    raise ChannelFullError(
                        f"expected room for one more event to {self.name}, found {BOUND} that "
                        "wait for the network: send less, or read them with keep=latest there"
                    )
                self._events += 1
            waiting = _Waiting(message, event, skip)
            self._queue.append(waiting)
            if skip:
                self._skippable[skip] = waiting
            self.peak = max(self.peak, len(self._queue))
            self._something.notify()

    def close(self, timeout: float = 2.0) -> None:
        """Write what waits, for so many seconds at most, and end."""
        with self._something:
            self._closed = True
            self._something.notify()
        self._thread.join(timeout)

    def abandon(self) -> None:
        """Write no more: there is nobody."""
        with self._something:
            self._queue.clear()
            self._closed = True
            self._something.notify()

    def _write(self) -> None:
        while True:
            with self._something:
                while not self._queue:
                    if self._closed:
                        return
                    self._something.wait()
                waiting = self._queue.popleft()
                self._skippable.pop(waiting.skip, None)
                if waiting.event is not None:
                    self._events -= 1
            try:
                frame = b"" if waiting.event is None else pack(waiting.event).frame()
                self._put(encode(waiting.message), frame)
            except VisnavError as error:
                self._failed(error)


class _Waiting:
    """One message in the line."""

    __slots__ = ("event", "message", "skip")

    def __init__(self, message: Message, event: Event | None, skip: str) -> None:
        self.message = message
        self.event = event
        self.skip = skip
