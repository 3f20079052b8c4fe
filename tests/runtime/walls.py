"""Runs a function on any of the clocks, with nothing of real time in it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any, Protocol, TypeVar

from runtime.run import event_loop as task_factory
from runtime.time.clock import SECOND, Clock, RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from tests.runtime.loops import turns

R = TypeVar("R")


class Wall:
    """Stands in for the module `time`, and for the alarm: when everybody waits, it jumps."""

    CLOCK_MONOTONIC = time.CLOCK_MONOTONIC

    def __init__(self) -> None:
        self.now = 77 * SECOND

    def monotonic_ns(self) -> int:
        return self.now

    def alarm(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> WallAlarm:
        return WallAlarm(self, loop, ring)


class WallAlarm:
    """Rings some turns of the loop after it was set, with the wall clock moved to its time."""

    def __init__(
        self, wall: Wall, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]
    ) -> None:
        self._wall, self._loop, self._ring = wall, loop, ring
        self._when = 0

    def set(self, when: int) -> None:
        self._when = when
        self._loop.create_task(self._jump(when))

    def close(self) -> None:
        self._when = 0

    async def _jump(self, when: int) -> None:
        await turns(10)
        if self._when == when:
            self._wall.now = max(self._wall.now, when)
            self._ring()


class RunClock(Protocol):
    """Runs a function of a clock that has begun."""

    def __call__(self, main: Callable[[Clock], Coroutine[Any, Any, R]]) -> R: ...


def on_clock(lockstep: bool, speed: float, main: Callable[[Clock], Coroutine[Any, Any, R]]) -> R:
    """Run a function of a clock that has begun, on a loop of its kind."""

    async def prepared() -> R:
        loop = asyncio.get_running_loop()
        task_factory.install(loop)
        clock = LockstepClock(loop) if isinstance(loop, LockstepLoop) else RealClock(loop, speed)
        assert clock.now() == 0
        clock.start()
        try:
            return await loop.create_task(main(clock))
        finally:
            clock.close()

    loops = LockstepLoop if lockstep else asyncio.SelectorEventLoop
    with asyncio.Runner(loop_factory=loops, debug=True) as runner:
        return runner.run(prepared())
