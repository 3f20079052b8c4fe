"""The run's clock, which is all that a node knows of time.

Two implementations: `runtime.time.lockstep` (simulated time that jumps) and
`runtime.time.real_clock`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from abc import ABC, abstractmethod
from typing import Literal, TypeVar

from runtime.time.schedule import SECOND, Once, Schedule

R = TypeVar("R")


class Clock(ABC):
    """Time of a run: integer nanoseconds from its start.

    Attributes:
        kind: ``real`` or ``lockstep``.
        schedule: What is due when on this clock.
    """

    kind: Literal["real", "lockstep"]
    schedule: Schedule

    @abstractmethod
    def now(self) -> int:
        """Return nanoseconds since the first update; 0 before it."""

    @abstractmethod
    async def beside(self, work: concurrent.futures.Future[R], latency: int = 0) -> R:
        """Await work done elsewhere, which takes `latency` nanoseconds of this clock.

        Its result is available at the time of the call plus `latency`. In lockstep exactly then:
        time runs on up to there and waits for slower work. In real time not before then.
        """

    async def sleep(self, seconds: float) -> None:
        """Wait for some seconds of this clock."""
        await self.sleep_until(self.now() + round(seconds * SECOND))

    async def sleep_until(self, stamp: int) -> None:
        """Wait until a time (ns) of this clock; return at once if it has passed."""
        if stamp <= self.now():
            await asyncio.sleep(0)
            return
        future = asyncio.get_running_loop().create_future()
        entry = Once(lambda: None if future.done() else future.set_result(None))
        self.schedule.add(stamp, entry)
        try:
            await future
        finally:
            entry.cancel()

    def start(self) -> None:  # noqa: B027  # simulated time has nothing to start
        """Let time run, from 0: the first update is now."""

    def hurry(self) -> None:  # noqa: B027  # real time has no order to keep
        """End soon: nothing that is due waits for slower work any more, as it would in order.

        For a run that ends by an error or by a signal: neither comes at a promised time.
        """

    def close(self) -> None:  # noqa: B027  # most clocks hold nothing
        """Give back what the clock holds."""
