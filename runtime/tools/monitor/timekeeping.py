"""Pausing, stepping and pacing simulated time.

In real time none of this is possible: sensors and vehicles do not wait.
"""

from __future__ import annotations

from collections.abc import Callable

from runtime.clock import Clock
from runtime.errors import CommandError
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.schedule import SECOND


class Timekeeper:
    """Has the say over a run's clock; a `runtime.lockstep.Gate` while time is to stand.

    Args:
        clock: The run's clock.
        over: Tells whether the run is ending, which takes time and cannot stand.
    """

    def __init__(self, clock: Clock, over: Callable[[], bool] = lambda: False) -> None:
        self._over = over
        self._loop = clock._loop if isinstance(clock, LockstepClock) else None
        self._limit = 0
        """The time (ns) beyond which nothing happens while this is the loop's gate."""

    def fixed(self) -> str:
        """Say why nothing here is possible; empty if it is."""
        if self._loop is None:
            return "the run is in real time, which cannot be stopped: sensors do not wait"
        if self._loop.gate not in {None, self}:
            return "the run goes on in other processes, too, and time is common to all"
        return ""

    @property
    def paused(self) -> bool:
        """Whether time stands, or will when a step has been taken."""
        return self._loop is not None and self._loop.gate is self

    @property
    def asked(self) -> float | None:
        """The speed that was asked for; `None`: as fast as it can, or real time."""
        if self._loop is None or not self._loop._pace:
            return None
        return round(1.0 / (self._loop._pace * SECOND), 9)

    def may_go(self, key: tuple[int, int, int]) -> bool:
        """Tell whether to go on to what is due next; asked by the loop."""
        return key[0] <= self._limit or self._over()

    def pause(self) -> None:
        """Let time stand.

        Raises:
            CommandError: It cannot.
        """
        loop = self._checked()
        self._limit = loop.now
        loop.gate = self

    def resume(self) -> None:
        """Let time run.

        Raises:
            CommandError: It cannot be stopped, and so it runs.
        """
        loop = self._checked()
        loop.gate = None
        loop._wall_origin = None  # or it would hurry to make good for the pause

    def step(self, seconds: float | None) -> None:
        """Let time run a little, and then stand.

        Args:
            seconds: How far; `None`: to the next thing due, and all that is due with it.

        Raises:
            CommandError: It cannot.
        """
        loop = self._checked()
        begin = max(loop.now, self._limit) if loop.gate is self else loop.now
        if seconds is None:
            self._limit = max(_next_due(loop), begin)
        else:
            self._limit = begin + round(seconds * SECOND)
        loop.gate = self
        loop._wall_origin = None

    def pace(self, factor: float | None) -> None:
        """Let time run at a speed.

        Args:
            factor: Simulated seconds per real second; `None`: as fast as it can.

        Raises:
            CommandError: It cannot.
        """
        loop = self._checked()
        loop._pace = 0.0 if factor is None else 1.0 / (factor * SECOND)
        loop._wall_origin = None

    def _checked(self) -> LockstepLoop:
        if reason := self.fixed():
            raise CommandError(reason)
        assert self._loop is not None
        return self._loop


def _next_due(loop: LockstepLoop) -> int:
    """Return when something is due next: of the schedule, a timer or work beside; 0 if nothing."""
    entry = loop.schedule.next_due()
    due = [] if entry is None else [entry]
    due += [round(timer.when() * SECOND) for timer in loop._scheduled[:1]]  # type: ignore[attr-defined]
    due += [held[0] for held in loop._held[:1]]
    return min(due, default=0)
