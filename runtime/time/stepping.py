"""Control of a run's clock: pause, step, speed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Literal

from runtime.errors import CommandError
from runtime.time.clock import SECOND, Clock
from runtime.time.lockstep import LockstepClock, LockstepLoop


class Stepping:
    """Control of a run's clock; the loop's `runtime.time.lockstep.Gate` while paused.

    All of its methods are called on the run's loop.

    Args:
        over: Tells whether the run is ending, which takes simulated time and cannot be paused.
        wall: Real seconds.
    """

    def __init__(
        self,
        clock: Clock,
        over: Callable[[], bool] = lambda: False,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        self._over = over
        self._wall = wall
        self._pauses: tuple[float | None, float] = None, 0.0
        """Start of the present pause (`wall`) or `None`, and seconds of earlier ones."""
        self._loop = clock._loop if isinstance(clock, LockstepClock) else None
        self._limit = 0
        self._steps: list[tuple[int, asyncio.Future[int]]] = []
        """Start (ns) and waiting future of each step in progress."""

    def fixed(self) -> str:
        """Return why time cannot be controlled; empty if controllable."""
        if self._loop is None:
            return "the run is in real time, which cannot be stopped: sensors do not wait"
        if self._loop.gate not in {None, self}:
            return "the run goes on in other processes, too, and time is common to all"
        return ""

    @property
    def state(self) -> Literal["running", "stepping", "paused"]:
        """Whether time runs, runs for a step, or is paused."""
        if self._loop is None or self._loop.gate is not self or self._over():
            return "running"
        return "stepping" if self._steps else "paused"

    @property
    def target_speed(self) -> float | None:
        """Requested speed; `None` for as fast as possible, or for real time."""
        if self._loop is None or not self._loop._pace:
            return None
        return round(1.0 / (self._loop._pace * SECOND), 9)

    def may_go(self, key: tuple[int, int, int]) -> bool:
        """Return whether the loop may run the next due entry."""
        if self._over():
            self._end_steps()
            return True
        if key[0] <= self._limit:
            return True
        assert self._loop is not None
        self._loop.now = max(self._loop.now, self._limit)  # nothing need be due there
        since, before = self._pauses
        self._pauses = self._wall() if since is None else since, before
        self._end_steps()
        return False

    def pause(self) -> None:
        """Pause time once all work due by now is done; ends a step. Raises as `resume` does."""
        loop = self._checked()
        self._limit = loop.now
        loop.gate = self

    def resume(self) -> None:
        """Resume time, and end a step; raise `CommandError` if time is not ours."""
        loop = self._checked()
        self._go_on()
        loop.gate = None
        loop._wall_origin = None  # else it would hurry to make up for the pause
        self._end_steps()

    def step(self, ns: int | None = None) -> asyncio.Future[int]:
        """Run for `ns` nanoseconds, or to the next due entry, then pause.

        A step requested during another is added to it. The result is the nanoseconds by which time
        has advanced: fewer if time was paused or resumed, or the run ended, before.

        Raises:
            CommandError: Time cannot be controlled.
            ValueError: `ns` is less than 1.
        """
        loop = self._checked()
        if ns is not None and ns < 1:
            raise ValueError(f"expected a step of 1 ns or more, found {ns}")
        self._go_on()
        begin = max(loop.now, self._limit) if loop.gate is self else loop.now
        self._limit = max(_next_due(loop), begin) if ns is None else begin + ns
        loop.gate = self
        loop._wall_origin = None
        done: asyncio.Future[int] = loop.create_future()
        self._steps.append((loop.now, done))
        return done

    def stands(self) -> asyncio.Future[int]:
        """Return a future done once time is paused; at once if no pause is requested.

        After `pause`, all else due now is still done before. Raises as `resume` does.
        """
        loop = self._checked()
        done: asyncio.Future[int] = loop.create_future()
        self._steps.append((loop.now, done))
        if loop.gate is not self:
            self._end_steps()
        return done

    def pace(self, factor: float | None) -> None:
        """Set the speed in simulated seconds per real second (`None`: unlimited)."""
        loop = self._checked()
        loop._pace = 0.0 if factor is None else 1.0 / (factor * SECOND)
        loop._wall_origin = None

    def real_seconds(self) -> float:
        """Return real seconds without pauses; in any thread."""
        since, before = self._pauses
        return (self._wall() if since is None else since) - before

    def _go_on(self) -> None:
        since, before = self._pauses
        if since is not None:
            self._pauses = None, before + self._wall() - since

    def _end_steps(self) -> None:
        assert self._loop is not None
        steps, self._steps = self._steps, []
        for begin, done in steps:
            if not done.done():  # the awaiting task may have been cancelled
                done.set_result(self._loop.now - begin)

    def _checked(self) -> LockstepLoop:
        if reason := self.fixed():
            raise CommandError(reason)
        assert self._loop is not None
        return self._loop


def _next_due(loop: LockstepLoop) -> int:
    """Return when the next entry, timer or work in a thread is due (ns); 0 if there is none."""
    entry = loop.schedule.next_due()
    due = [] if entry is None else [entry]
    due += [round(timer.when() * SECOND) for timer in loop._scheduled[:1]]  # type: ignore[attr-defined]
    due += [held[0] for held in loop._held[:1]]
    return min(due, default=0)
