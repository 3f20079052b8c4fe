"""Pauses and steps simulated time, and sets its speed.

None of this is possible in real time: sensors and vehicles do not wait.
"""

from __future__ import annotations

from collections.abc import Callable

from runtime.clock import Clock
from runtime.errors import CommandError
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.schedule import SECOND


class Timekeeper:
    """Controls a run's clock; it is the loop's `runtime.lockstep.Gate` while time is paused.

    Args:
        clock: The run's clock.
        over: Tells whether the run is ending, which takes simulated time and cannot be paused.
    """

    def __init__(self, clock: Clock, over: Callable[[], bool] = lambda: False) -> None:
        self._over = over
        self._loop = clock._loop if isinstance(clock, LockstepClock) else None
        self._limit = 0
        """The time (ns) up to which the loop may go while this is its gate."""

    def fixed(self) -> str:
        """Return why time cannot be controlled; empty if it can."""
        if self._loop is None:
            return "the run is in real time, which cannot be stopped: sensors do not wait"
        if self._loop.gate not in {None, self}:
            return "the run goes on in other processes, too, and time is common to all"
        return ""

    @property
    def paused(self) -> bool:
        """Whether time is paused, or will be after the current step."""
        return self._loop is not None and self._loop.gate is self

    @property
    def target_speed(self) -> float | None:
        """The speed that was asked for; `None`: as fast as it can, or real time."""
        if self._loop is None or not self._loop._pace:
            return None
        return round(1.0 / (self._loop._pace * SECOND), 9)

    def may_go(self, key: tuple[int, int, int]) -> bool:
        """Tell whether the loop may go on to what is due next."""
        return key[0] <= self._limit or self._over()

    def pause(self) -> None:
        """Pause time.

        Raises:
            CommandError: Time cannot be controlled.
        """
        loop = self._checked()
        self._limit = loop.now
        loop.gate = self

    def resume(self) -> None:
        """Resume time.

        Raises:
            CommandError: Time cannot be controlled.
        """
        loop = self._checked()
        loop.gate = None
        loop._wall_origin = None  # else it would hurry to make up for the pause

    def step(self, seconds: float | None) -> None:
        """Let time run a little, and then pause.

        Args:
            seconds: How far; `None`: to what is due next, all at the same time included.

        Raises:
            CommandError: Time cannot be controlled.
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
        """Set the speed of time.

        Args:
            factor: Simulated seconds per real second; `None`: as fast as it can.

        Raises:
            CommandError: Time cannot be controlled.
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
    """Return when the next entry, timer or work in a thread is due (ns); 0 if there is none."""
    entry = loop.schedule.next_due()
    due = [] if entry is None else [entry]
    due += [round(timer.when() * SECOND) for timer in loop._scheduled[:1]]  # type: ignore[attr-defined]
    due += [held[0] for held in loop._held[:1]]
    return min(due, default=0)
