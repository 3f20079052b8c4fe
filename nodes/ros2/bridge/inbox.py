"""Passes messages from the threads that read topics to the loop: bounded, one wake-up a burst.

What comes faster than is allowed is dropped where it is read, before its bytes are copied. The
loop is given back between messages when they have held it for `BUDGET`.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable

from nodes.ros2.bridge.attachment import Message

BUDGET = 0.0005
"""Seconds for which one turn of the loop may be held."""


class Inbox:
    """What waits to be read on one topic.

    Args:
        loop: Where messages are read.
        deliver: Called there with the bytes of each; must not raise.
        depth: How many wait at most; the oldest is dropped.
        max_rate: Messages a second at most; a burst of `depth` may come at once.
        max_size: Bytes of a message at most.
        complain: Called, in the thread that reads, with why a message is dropped.
        now: Real seconds.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        deliver: Callable[[bytes], object],
        *,
        depth: int,
        max_rate: float,
        max_size: int,
        complain: Callable[[str, str], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loop = loop
        self._deliver = deliver
        self._depth = depth
        self._max_rate = max_rate
        self._max_size = max_size
        self._complain = complain
        self._now = now
        self._waiting: deque[bytes] = deque()
        self._lock = threading.Lock()
        self._allowed, self._asked = float(depth), now()
        self._woken = False
        self.wake_ups = 0

    def take(self, message: Message) -> None:
        """Take a message, in any thread; never waits."""
        if message.size > self._max_size:
            found = f"expected {self._max_size} bytes or less, found {message.size}"
            self._complain("message too large", found)
            return
        if not self._within_rate():
            self._complain("too many messages", f"expected {self._max_rate:g} a second or less")
            return
        data = message.read()
        with self._lock:
            full = len(self._waiting) == self._depth
            if full:
                self._waiting.popleft()
            self._waiting.append(data)
            wake, self._woken = not self._woken, True
        if full:
            self._complain("more messages than wait here", f"the oldest of {self._depth} dropped")
        if wake:
            with contextlib.suppress(RuntimeError):  # the loop has been closed
                self._loop.call_soon_threadsafe(self._drain)

    def _within_rate(self) -> bool:
        """Tell whether one more message fits; every second allows for `max_rate` more."""
        with self._lock:
            now = self._now()
            more = (now - self._asked) * self._max_rate
            self._allowed, self._asked = min(self._allowed + more, float(self._depth)), now
            if self._allowed < 1.0:
                return False
            self._allowed -= 1.0
            return True

    def _drain(self) -> None:
        self.wake_ups += 1
        end = time.perf_counter() + BUDGET
        while True:
            with self._lock:
                if not self._waiting:
                    self._woken = False
                    return
                data = self._waiting.popleft()
            self._deliver(data)
            if time.perf_counter() > end:
                self._loop.call_soon(self._drain)
                return
