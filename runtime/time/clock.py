"""The run's clock: all a node knows of time.

Two implementations: `runtime.time.lockstep` (simulated time that jumps) and `RealClock`, whose
ticks come from a Linux timerfd, because uvloop's own timers have a grain of 1 ms.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import ctypes
import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, Protocol, TypeVar

from runtime.time.schedule import SECOND, Once, Schedule

R = TypeVar("R")


class Clock(ABC):
    """Time of a run: integer nanoseconds from its start."""

    kind: Literal["real", "lockstep"]
    schedule: Schedule

    @abstractmethod
    def now(self) -> int:
        """Return nanoseconds since the first update; 0 before."""

    @abstractmethod
    async def beside(self, work: concurrent.futures.Future[R], latency: int = 0) -> R:
        """Await work done elsewhere, taking `latency` nanoseconds of this clock.

        Its result is available at the time of the call plus `latency`. In lockstep exactly then:
        time runs on up to there and waits for slower work. In real time not before then.
        """

    async def sleep(self, seconds: float) -> None:
        """Wait for some seconds of this clock."""
        await self.sleep_until(self.now() + round(seconds * SECOND))

    async def sleep_until(self, stamp: int) -> None:
        """Wait until a time (ns) of this clock; return at once if already past."""
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
        """End soon, by an error or a signal: nothing due waits for slower work any more."""

    def close(self) -> None:  # noqa: B027  # most clocks hold nothing
        """Release the clock's resources."""


class Alarm(Protocol):
    """Calls a function at a time of `time.monotonic_ns`."""

    def set(self, when: int) -> None:
        """Ring at `when` (ns) instead of whatever was set before."""

    def close(self) -> None:
        """Ring no more."""


class RealClock(Clock):
    """Nanoseconds since the first update, times `speed` (seconds of this clock per real second)."""

    kind: Literal["real"] = "real"

    def __init__(self, loop: asyncio.AbstractEventLoop, speed: float = 1.0) -> None:
        self.speed = speed
        self._pace: _Pace | None = None
        make = TimerFd if sys.platform == "linux" else LoopAlarm
        self._alarm: Alarm = make(loop, self._ring)
        self.schedule = Schedule()
        self.schedule.on_sooner = self._set_alarm

    def now(self) -> int:
        """Return nanoseconds since the first update; 0 before. In any thread."""
        return 0 if self._pace is None else self._pace.at(time.monotonic_ns())

    def start(self) -> None:
        """Let time run, from 0."""
        self.start_at(time.monotonic_ns())

    def start_at(self, origin: int) -> None:
        """Let time run, from 0 at a time of `time.monotonic_ns`."""
        self._pace = _Pace(origin, 0, self.speed)
        self._ring()

    def steer(self, factor: float) -> None:
        """Let time run a little quicker or slower than its speed from here on, without a jump."""
        now = time.monotonic_ns()
        then = 0 if self._pace is None else self._pace.at(now)
        self._pace = _Pace(now, then, self.speed * factor)
        due = self.schedule.next_due()
        if due is not None:
            self._set_alarm(due)

    async def beside(self, work: concurrent.futures.Future[R], latency: int = 0) -> R:
        """Await work done elsewhere; its result comes no earlier than `latency` ns from now."""
        due = self.now() + latency
        result = await asyncio.wrap_future(work)
        if latency and due > self.now():
            await self.sleep_until(due)
        return result

    async def sleep_until(self, stamp: int) -> None:
        """Wait until a time (ns) of this clock; in real time before the first update."""
        if self._pace is None:
            await asyncio.sleep(stamp / self.speed / SECOND)
        else:
            await super().sleep_until(stamp)

    def close(self) -> None:
        """Ring no more."""
        self._alarm.close()

    def _ring(self) -> None:
        self.schedule.on_sooner = _ignore  # while running what is due, one setting at the end
        try:
            self.schedule.run_due(self.now)
        finally:
            self.schedule.on_sooner = self._set_alarm
            due = self.schedule.next_due()
            if due is not None:
                self._set_alarm(due)

    def _set_alarm(self, due: int) -> None:
        if self._pace is not None:
            self._alarm.set(self._pace.when(due))


class _Pace:
    """Linear map from `time.monotonic_ns` to the run's time, from a point on."""

    __slots__ = ("_rate", "_since", "_then")

    def __init__(self, since: int, then: int, rate: float) -> None:
        self._since = since
        self._then = then
        self._rate = rate

    def at(self, now: int) -> int:
        elapsed = max(now - self._since, 0)
        return self._then + (elapsed if self._rate == 1.0 else int(elapsed * self._rate))

    def when(self, due: int) -> int:
        return self._since + math.ceil((due - self._then) / self._rate)


class TimerFd:
    """An alarm on timerfd_create(2), read by the loop like any file."""

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        self._loop = loop
        self._ring = ring
        self._fd = _libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")
        loop.add_reader(self._fd, self._read)

    def set(self, when: int) -> None:
        """Ring at `when` (ns of the monotonic clock)."""
        setting = (ctypes.c_long * 4)(0, 0, *divmod(max(when, 1), SECOND))
        if _libc.timerfd_settime(self._fd, _ABSOLUTE, setting, None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")

    def close(self) -> None:
        """Close the file."""
        self._loop.remove_reader(self._fd)
        os.close(self._fd)

    def _read(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:  # set anew between ringing and reading
            return
        self._ring()


class LoopAlarm:
    """An alarm on the loop's own timers, where there is no timerfd."""

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        self._loop = loop
        self._ring = ring
        self._handle: asyncio.TimerHandle | None = None

    def set(self, when: int) -> None:
        """Ring at `when` (ns of the monotonic clock)."""
        self.close()
        delay = (when - time.monotonic_ns()) / SECOND
        self._handle = self._loop.call_later(max(delay, 0.0), self._ring)

    def close(self) -> None:
        """Ring no more."""
        if self._handle is not None:
            self._handle.cancel()


# struct itimerspec {interval: {s, ns}, value: {s, ns}} is four C longs. (os.timerfd_create came
# with Python 3.13.)
_libc = ctypes.CDLL(None, use_errno=True)
_ABSOLUTE = 1  # TFD_TIMER_ABSTIME


def _ignore(_: int) -> None:
    pass
