"""Clock of a run, and the schedule of ticks and other entries due on it.

Two implementations: `runtime.time.lockstep` (simulated time that jumps) and `RealClock`, whose
ticks come from a Linux timerfd, because uvloop's own timers have a grain of 1 ms.

Both clocks keep one `Schedule`; they differ in how they get from one due time to the next. Entries
due at the same time run in the order in which they were added, which for ticks is the order of the
nodes in the file. A `Histogram` of lateness costs one addition a sample and never grows.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import ctypes
import heapq
import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from fractions import Fraction
from typing import Any, Literal, Protocol, TypeVar

import msgspec

from runtime.errors import raisable

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
        time runs on up to there and waits for slower work. In real time not before then. Its error
        is raised as `raisable` says.
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
        """Start time at 0: the first update is now."""

    def hurry(self) -> None:  # noqa: B027  # real time has no order to keep
        """Process finished work from now on without waiting for earlier work (the run ends)."""

    def close(self) -> None:  # noqa: B027  # most clocks hold nothing
        """Release the clock's resources."""


async def result_of(work: concurrent.futures.Future[R]) -> R:
    """Await work done elsewhere, on a loop in real time; its error is raised as `raisable` says.

    Cancelling the wait cancels work that has not begun.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[R] = loop.create_future()

    def done(finished: concurrent.futures.Future[R]) -> None:  # no circle: results may be large
        with contextlib.suppress(RuntimeError):  # the loop is closed: nothing awaits the result
            loop.call_soon_threadsafe(settle, future, finished)

    work.add_done_callback(done)
    try:
        return await future
    except asyncio.CancelledError:
        work.cancel()
        raise


def settle(future: asyncio.Future[Any], work: concurrent.futures.Future[Any]) -> None:
    """Copy the outcome of finished work to a future, unless that is cancelled."""
    if future.cancelled():
        return
    if work.cancelled():
        future.cancel()
    elif (error := work.exception()) is not None:
        future.set_exception(raisable(error))
    else:
        future.set_result(work.result())


class Alarm(Protocol):
    """Calls a function at a time of `time.monotonic_ns`."""

    def set(self, when: int) -> None:
        """Set the alarm time (ns); replaces the earlier one."""

    def close(self) -> None:
        """Cancel the alarm and close its file."""


class RealClock(Clock):
    """Nanoseconds since the first update, times `speed` (seconds of this clock per real second)."""

    kind: Literal["real"] = "real"

    def __init__(self, loop: asyncio.AbstractEventLoop, speed: float = 1.0) -> None:
        self.speed = speed
        self._pace: _Pace | None = None
        make = TimerFd if sys.platform == "linux" else LoopAlarm
        self._alarm: Alarm = make(loop, self._run_due)
        self.schedule = Schedule()
        self.schedule.on_sooner = self._set_alarm

    def now(self) -> int:
        """Return nanoseconds since the first update; 0 before. In any thread."""
        return 0 if self._pace is None else self._pace.at(time.monotonic_ns())

    def start(self) -> None:
        """Start time at 0."""
        self.start_at(time.monotonic_ns())

    def start_at(self, origin: int) -> None:
        """Start time, 0 at a time of `time.monotonic_ns`."""
        self._pace = _Pace(origin, 0, self.speed)
        self._run_due()

    def steer(self, factor: float) -> None:
        """Change the rate of time from now on to `factor` times the speed, without a jump."""
        now = time.monotonic_ns()
        then = 0 if self._pace is None else self._pace.at(now)
        self._pace = _Pace(now, then, self.speed * factor)
        due = self.schedule.next_due()
        if due is not None:
            self._set_alarm(due)

    async def beside(self, work: concurrent.futures.Future[R], latency: int = 0) -> R:
        """Await work done elsewhere; its result comes no earlier than `latency` ns from now."""
        due = self.now() + latency
        result = await result_of(work)
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
        """Close the alarm."""
        self._alarm.close()

    def _run_due(self) -> None:
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

    def __init__(self, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
        self._loop = loop
        self._call = call
        self._fd = _libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")
        loop.add_reader(self._fd, self._read)

    def set(self, when: int) -> None:
        """Set the alarm time (ns of the monotonic clock)."""
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
        except BlockingIOError:  # set anew between expiry and reading
            return
        self._call()


class LoopAlarm:
    """An alarm on the loop's own timers, where there is no timerfd."""

    def __init__(self, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
        self._loop = loop
        self._call = call
        self._handle: asyncio.TimerHandle | None = None

    def set(self, when: int) -> None:
        """Set the alarm time (ns of the monotonic clock)."""
        self.close()
        delay = (when - time.monotonic_ns()) / SECOND
        self._handle = self._loop.call_later(max(delay, 0.0), self._call)

    def close(self) -> None:
        """Cancel the alarm."""
        if self._handle is not None:
            self._handle.cancel()


# struct itimerspec {interval: {s, ns}, value: {s, ns}} is four C longs. (os.timerfd_create came
# with Python 3.13.)
_libc = ctypes.CDLL(None, use_errno=True)
_ABSOLUTE = 1  # TFD_TIMER_ABSTIME


def _ignore(_: int) -> None:
    pass


_STEPS = 5  # bits of a value that are kept below its leading one


class DurationHistogram:
    """Durations in nanoseconds, counted by size."""

    __slots__ = ("_counts", "_none", "maximum")

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self._none = 0
        self.maximum = 0

    def add(self, duration: int) -> None:
        """Count a duration (ns); negative values count as 0."""
        if duration <= 0:  # always so in lockstep
            self._none += 1
            return
        self.maximum = max(self.maximum, duration)
        shift = max(duration.bit_length() - _STEPS - 1, 0)
        bucket = (duration >> shift) + (shift << (_STEPS + 1))
        self._counts[bucket] = self._counts.get(bucket, 0) + 1

    def count(self) -> int:
        """Return how many durations were added."""
        return self._none + sum(self._counts.values())

    def quantile(self, q: float) -> int:
        """Return the duration (ns) not exceeded by a share `q` of all; 0 if none."""
        rank = q * self.count()
        seen = self._none
        if seen >= rank:
            return 0
        for bucket in sorted(self._counts, key=_upper_edge):
            seen += self._counts[bucket]
            if seen >= rank:
                return min(_upper_edge(bucket), self.maximum)
        return self.maximum


def _upper_edge(bucket: int) -> int:
    shift = bucket >> (_STEPS + 1)
    value = bucket & ((1 << (_STEPS + 1)) - 1)
    return ((value + 1) << shift) - 1


SECOND = 1_000_000_000


class Tick(msgspec.Struct, frozen=True, gc=False):
    """A call of an `@every` method.

    Attributes:
        stamp: Nanoseconds at which it was due. After missed ticks, the last of them.
        index: Periods since the first tick.
        late: Nanoseconds from the first due time not yet served to this call.
        missed: Ticks skipped because the last call or something else took too long.
    """

    stamp: int
    index: int
    late: int
    missed: int


class Entry(Protocol):
    """Something in the schedule."""

    def fire(self, due: int, now: int) -> int | None:
        """Run, and return when to run again, or `None`."""


class Schedule:
    """A queue of due times."""

    def __init__(self) -> None:
        self.heap: list[tuple[int, int, Entry]] = []
        self.order = 0  # number of the next entry added; the lowest comes first among equal times
        self.on_sooner: Callable[[int], None] = _ignore
        """Called when an entry is added with a due time (ns) before all others."""

    def add(self, due: int, entry: Entry) -> None:
        """Run `entry` at `due`, after entries added earlier for the same time."""
        order = self.order
        self.order = order + 1
        self._push((due, order, entry))

    def next_due(self) -> int | None:
        """Return the earliest due time, or `None` if nothing is due ever."""
        return self.heap[0][0] if self.heap else None

    def run_first(self, now: int) -> None:
        """Run the entry due first; when repeated, its place among equal times stays."""
        heap = self.heap
        item = due, order, entry = heap[0]
        again = None
        try:
            again = entry.fire(due, now)
        finally:
            if heap[0] is not item:  # it added something for an earlier time
                heap.remove(item)
                heapq.heapify(heap)
                heapq.heappush(heap, item := (-1, order, entry))
            if again is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (again, order, entry))

    def run_due(self, now: Callable[[], int]) -> None:
        """Run all entries due by now, in order; those due meanwhile are left for later."""
        limit = now()
        while self.heap and self.heap[0][0] <= limit:
            self.run_first(now())

    def _push(self, item: tuple[int, int, Entry]) -> None:
        heapq.heappush(self.heap, item)
        if self.heap[0] is item:
            self.on_sooner(item[0])


class Once:
    """Calls a function once, unless cancelled before."""

    __slots__ = ("call",)

    def __init__(self, call: Callable[[], Any]) -> None:
        self.call: Callable[[], Any] | None = call

    def fire(self, due: int, now: int) -> None:  # noqa: ARG002
        """Call the function, unless cancelled."""
        if self.call is not None:
            self.call()

    def cancel(self) -> None:
        """Cancel the call."""
        self.call = None


class Ticker:
    """Calls a function at a steady rate.

    Args:
        name: ``node.method``, for statistics.
        hz: Rate; due times are exact multiples of its period, rounded down to nanoseconds.
        fault: Called with what `call` raises.
        before: The ticker that this one replaces, whose statistics it carries on.
    """

    __slots__ = (
        "_call", "_fault", "_function", "_hz", "_index", "_period", "_start", "calls", "late",
        "missed", "name", "stopped",
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        hz: float,
        call: Callable[[Tick], Any],
        fault: Callable[[BaseException], None],
        before: Ticker | None = None,
    ) -> None:
        self.name = name
        self.calls: int = before.calls if before else 0
        self.missed: int = before.missed if before else 0
        self.late: DurationHistogram = before.late if before else DurationHistogram()
        self.stopped = False
        self._hz = Fraction(hz).limit_denominator(1_000_000) or Fraction(hz)
        self._period = SECOND * self._hz.denominator  # times the numerator: an integer
        self._function = self._call = call
        self._fault = fault
        self._start = 0
        self._index = 0

    def wrap_call(self, wrap: Callable[[Callable[[Tick], Any]], Callable[[Tick], Any]]) -> None:
        """Call the function wrapped by `wrap` from now on, without any earlier wrapper."""
        self._call = wrap(self._function)

    def begin(self, start: int) -> None:
        """Have the first tick at `start` (ns)."""
        self._start = start
        self._index = 0

    @property
    def hz(self) -> float:
        """Ticks per second."""
        return float(self._hz)

    @property
    def due(self) -> int:
        """When the next tick is due (ns)."""
        return self._start + self._index * self._period // self._hz.numerator

    def fire(self, due: int, now: int) -> int | None:
        """Call the function, and return its next due time (ns); `None` if stopped."""
        if self.stopped:
            return None
        late = now - due
        missed = 0
        if late > 0:
            last = (now - self._start) * self._hz.numerator // self._period
            missed = max(last - self._index, 0)
            if missed:
                self._index += missed
                self.missed += missed
        tick = Tick(self.due if missed else due, self._index, late, missed)
        self._index += 1
        self.calls += 1
        self.late.add(late)
        try:
            self._call(tick)
        except BaseException as error:  # even that must not take the other ticks with it
            self._fault(error)
        return self.due
