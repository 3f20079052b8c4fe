"""The answer to one frame for a system outside the process, to be awaited."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Generator
from typing import Any, Generic, TypeVar

from runtime.time.clock import Clock

T = TypeVar("T")

LET_GO: Any = object()
"""The outcome of a wait that has ended without an answer, which may still come."""


class Owed(Generic[T]):
    """The answer to one frame, to be awaited once: its content, or `None` if there is none.

    Raises:
        MissingAnswerError: There is none, and by `HoldConfig.on_missing` that is an error.
    """

    __slots__ = ("_clock", "due", "later", "since", "stamp", "work")

    def __init__(self, clock: Clock, stamp: int, due: int, since: float) -> None:
        self._clock = clock
        self.stamp = stamp
        self.due = due
        self.since = since
        self.work = future()
        self.later: concurrent.futures.Future[Any] | None = None
        """Its answer, once time waits for it no more."""

    def __await__(self) -> Generator[Any, None, T | None]:
        return self._answer().__await__()

    async def _answer(self) -> T | None:
        latency = max(self.due - self._clock.now(), 0)
        result = await self._clock.beside(self.work, latency)
        if self.later is not None and result is LET_GO:
            result = await asyncio.wrap_future(self.later)
        found: T | None = result
        return found


def future() -> concurrent.futures.Future[Any]:
    """Return a future that a reader who stops waiting does not cancel."""
    made: concurrent.futures.Future[Any] = concurrent.futures.Future()
    made.set_running_or_notify_cancel()
    return made
