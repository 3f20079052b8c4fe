"""Simulated time: an asyncio loop with jumps to the next due time, and its clock.

A selector loop calls `select(timeout)` with a timeout above zero only when nothing is ready to
run. Then, instead of sleeping, this loop moves its clock: to the next timer of asyncio's (so plain
`asyncio.sleep` and `asyncio.timeout` are simulated), to the next entry of the schedule, which it
runs on the spot, or to the due time of offloaded work, for which it waits if it must. Things due
at one time run in that order, however the outside world is interleaved, so the same program gives
the same events on any machine.

Sockets and threads of other libraries are served too, but when their answers arrive is not
simulated; only `Clock.beside` (that is, `Node.offload` and workers), `asyncio.to_thread` and
`loop.run_in_executor` are.

A self-test, once per process, tells whether this interpreter's asyncio works as relied on here.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import contextvars
import functools
import heapq
import itertools
import selectors
import time
from collections.abc import Callable
from typing import Any, Literal, Protocol, TypeVar

from runtime.errors import UnsupportedInterpreterError
from runtime.interpreter import PYTHON, passes
from runtime.logs import executor
from runtime.time.clock import SECOND, Clock, Once, Schedule, settle

R = TypeVar("R")
_Work = concurrent.futures.Future[Any]
_Ready = list[tuple[selectors.SelectorKey, int]]
_Held = tuple[int, int, _Work, asyncio.Future[Any]]
"""Work done elsewhere: due time (ns), order, outcome, and the awaiting future."""

_NEVER = 1 << 62
_POLL_EVERY = 64  # jumps between two looks at real files (signals, sockets) while time runs freely


class _JumpingSelector(selectors.DefaultSelector):
    advance: Callable[[float | None], _Ready]

    def select(self, timeout: float | None = None) -> _Ready:
        return self.advance(timeout)

    def wait(self, timeout: float | None) -> _Ready:
        """Wait for files, in real time."""
        return super().select(timeout)


class Gate(Protocol):
    """Decides when time may advance: other processes may have to, first."""

    def may_go(self, key: tuple[int, int, int]) -> bool:
        """Return whether to run the next due entry: its time (ns), kind and order."""


class _Timer(asyncio.TimerHandle):
    """Timer sorted by order of setting among equal times; a bare heap mixes them."""

    __slots__ = ("order",)

    order: int

    def __lt__(self, other: _Timer) -> bool:  # type: ignore[override]
        mine, others = self.when(), other.when()
        return mine < others or (mine == others and self.order < other.order)


class LockstepLoop(asyncio.SelectorEventLoop):
    """A loop on simulated time.

    Args:
        speed: Simulated seconds per real second, or `None` for as fast as possible.
    """

    def __init__(self, speed: float | None = None) -> None:
        self.schedule = Schedule()
        self.now = 0
        self.gate: Gate | None = None
        self.hurried = False
        """Whether due work is taken once done, out of its order: see `Clock.hurry`."""
        self._held: list[_Held] = []
        self._orders = itertools.count()
        self._jumps = 0
        self._pace = 0.0 if speed is None else 1.0 / (speed * SECOND)
        self._wall_origin: float | None = None
        selector = _JumpingSelector()
        selector.advance = self._advance
        self._jumping = selector
        super().__init__(selector)
        self._clock_resolution = 1e-9
        self.set_default_executor(executor("node"))

    def time(self) -> float:
        """Return simulated seconds."""
        return self.now / SECOND

    def call_at(  # type: ignore[override]
        self,
        when: float,
        callback: Callable[..., Any],
        *args: Any,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        """Call a function at a simulated time, after those set before for this time."""
        self._check_closed()  # type: ignore[attr-defined]
        timer = _Timer(when, callback, args, self, context)
        timer.order = next(self._orders)
        timer._scheduled = True  # type: ignore[attr-defined]  # it is in the heap
        heapq.heappush(self._scheduled, timer)  # type: ignore[attr-defined]
        return timer

    def hold(self, work: _Work, due: int) -> asyncio.Future[Any]:
        """Return a future set to the outcome of `work` exactly at simulated time `due`."""
        future = self.create_future()
        heapq.heappush(self._held, (due, next(self._orders), work, future))
        work.add_done_callback(lambda _: self._wake_up())
        return future

    def run_in_executor(  # type: ignore[override]
        self, executor: concurrent.futures.Executor | None, func: Callable[..., R], *args: Any
    ) -> asyncio.Future[R]:
        """Run a function beside the loop; simulated time waits for its end."""
        executor = executor or self._default_executor  # type: ignore[attr-defined]
        return self.hold(executor.submit(func, *args), self.now)

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ARG002, ASYNC109
        """Stop without joining the threads: a time-out would be simulated, and over at once."""
        self._default_executor.shutdown(wait=False, cancel_futures=True)  # type: ignore[attr-defined]

    def orders(self) -> tuple[int, int]:
        """Return the order numbers of the next entries: the schedule's and all others'.

        Of things due at one time, those with lower numbers come first.
        """
        order = next(self._orders)
        self._orders = itertools.count(order)
        return self.schedule.order, order

    def move(self, now: int, orders: tuple[int, int]) -> None:
        """Set time and sequence numbers from another process."""
        self.now = max(self.now, now)
        self.schedule.order = orders[0]
        self._orders = itertools.count(orders[1])

    def waits_for(self) -> asyncio.Future[Any] | Literal["pace", "nothing"] | None:
        """Return the cause of waiting time: offloaded work, pace, or nothing ever due.

        `None` if time does not wait, and ready callbacks run; called on the loop.
        """
        entry = self.schedule.next_due()
        held = self._held[0][0] if self._held else _NEVER
        timers: Any = self._scheduled  # type: ignore[attr-defined]
        timer = round(timers[0].when() * SECOND) if timers else _NEVER
        due = min(_NEVER if entry is None else entry, held, timer)
        if self._ready:  # type: ignore[attr-defined]
            return None
        if due == _NEVER:
            return "nothing"
        if held == due < timer and not self._held[0][2].done():
            return self._held[0][3]
        return "pace" if self._pace and due > self.now else None

    def _wake_up(self) -> None:
        with contextlib.suppress(RuntimeError):  # closed: nothing awaits the result
            self.call_soon_threadsafe(_nothing)

    def _advance(self, timeout: float | None) -> _Ready:
        """Stand in for the selector's sleep: run simulated time until asyncio has work again."""
        ready: Any = self._ready  # type: ignore[attr-defined]
        timers: Any = self._scheduled  # type: ignore[attr-defined]
        wait = self._jumping.wait
        held_work = self._held
        schedule, entries = self.schedule, self.schedule.heap
        while not ready and timeout != 0:
            self._jumps += 1
            if self._jumps % _POLL_EVERY == 0 and (events := wait(0)):
                return events
            entry = entries[0][0] if entries else _NEVER
            held = held_work[0][0] if held_work else _NEVER
            timer = round(timers[0].when() * SECOND) if timers else _NEVER
            due = entry if entry < held else held
            if timer < due:
                due = timer
            if due < self.now:
                due = self.now
            if self.gate is not None:
                may_go = self.gate.may_go(self._key(due, timer, held))
                if ready:  # by what the gate has done
                    return []
                if not may_go:
                    return wait(None)
            if due == self.now:
                pass
            elif due == _NEVER:
                return wait(None)
            elif self._pace and (events := self._wait_until(due)):
                return events
            if timer <= due:
                if not timers[0].cancelled():  # the loop throws those out
                    self.now = due
                return []
            if held <= due:
                if not _is_over(held_work[0]) and not (self.hurried and self._promote(due)):
                    return wait(None)
                self.now = due
                _, _, work, future = heapq.heappop(held_work)
                settle(future, work)
            else:
                self.now = due
                schedule.run_first(due)
            if self._stopping:  # type: ignore[attr-defined]
                return []
        self._jumps += 1
        return wait(0) if self._jumps % _POLL_EVERY == 0 or timeout == 0 else []

    def _promote(self, due: int) -> bool:
        """Move finished work ahead of other due work; return whether there is any."""
        over = [work for work in self._held if work[0] <= due and _is_over(work)]
        if over:
            self._held.remove(first := min(over))
            heapq.heapify(self._held)
            heapq.heappush(self._held, (first[0], -1, *first[2:]))
        return bool(over)

    def _key(self, due: int, timer: int, held: int) -> tuple[int, int, int]:
        """Return the place of the next due entry in all processes: time, kind, order."""
        if due == _NEVER:
            return (_NEVER, 3, 0)
        if timer <= due:
            return (due, 0, self._scheduled[0].order)  # type: ignore[attr-defined]
        if held <= due:
            return (due, 1, self._held[0][1])
        return (due, 2, self.schedule.heap[0][1])

    def _wait_until(self, due: int) -> _Ready:
        """Sleep until simulated time may be `due` at the set speed, or until a file is ready."""
        wall = time.monotonic()
        if self._wall_origin is None:
            self._wall_origin = wall - self.now * self._pace
        rest = self._wall_origin + due * self._pace - wall
        return self._jumping.wait(rest) if rest > 0 else []


@functools.cache
def check_interpreter() -> None:
    """Raise `UnsupportedInterpreterError` if time cannot be simulated here, by a self-test."""
    if not passes(LockstepLoop, _exercise):
        raise UnsupportedInterpreterError(
            f"expected an asyncio on which time can be simulated, such as Python's from 3.11 to "
            f'3.14, found {PYTHON}: use one of those, or clock = "real"'
        )


async def _exercise(loop: asyncio.AbstractEventLoop) -> bool:
    """Wait for timers, the schedule and work beside the loop; return whether the order is right."""
    assert isinstance(loop, LockstepLoop)
    order: list[tuple[str, float]] = []

    def record(name: str) -> None:
        order.append((name, loop.time()))

    for name in "abcdef":  # at one time; a bare heap would mix them
        loop.call_at(2.0, record, name)
    loop.call_at(3.0, record, "cancelled").cancel()
    loop.schedule.add(2 * SECOND, Once(lambda: record("schedule")))
    loop.schedule.add(SECOND, Once(lambda: record("early")))
    work = loop.run_in_executor(None, record, "beside")
    await work
    await asyncio.sleep(2.5)
    expected = [("beside", 0.0), ("early", 1.0), *((name, 2.0) for name in [*"abcdef", "schedule"])]
    return order == expected and loop.now == 5 * SECOND // 2


class LockstepClock(Clock):
    """The clock of a run on a `LockstepLoop`."""

    kind: Literal["lockstep"] = "lockstep"

    def __init__(self, loop: LockstepLoop) -> None:
        self._loop = loop
        self.schedule = loop.schedule

    def now(self) -> int:
        """Return simulated nanoseconds since the run began."""
        return self._loop.now

    def hurry(self) -> None:
        """Process finished work immediately, ignoring its order."""
        self._loop.hurried = True

    async def beside(self, work: concurrent.futures.Future[R], latency: int = 0) -> R:
        """Await work done elsewhere; its result comes exactly `latency` ns from now."""
        result: R = await self._loop.hold(work, self._loop.now + latency)
        return result


def _is_over(held: _Held) -> bool:
    return held[2].done() or held[3].cancelled()


def _nothing() -> None:
    """Do nothing: only called to wake the loop."""
