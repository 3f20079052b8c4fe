"""What waits to be written, bounded by bytes: one thread puts, another takes, and neither locks.

References only: putting an event copies and encodes nothing.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from events import Event

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
