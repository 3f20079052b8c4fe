"""Real time on several machines: beginning together, and staying so though quartzes differ.

Two machines' clocks part by some 20 µs a second. Ours runs a little quicker or slower until it
shows what the other one does, and never jumps.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any

from runtime.peers.member import KEPT, Member
from runtime.peers.messages import Ping
from runtime.time.clock import RealClock
from runtime.time.schedule import SECOND

PERIOD = 0.1  # seconds between two exchanges
EXCHANGES = 10  # exchanges for each correction of our clock; the quickest gives its lateness

LIMIT = 500e-6
"""Greatest relative change of our clock's rate, as in NTP; quartzes differ by a tenth of this."""


async def compare(
    member: Member, until: Callable[[Callable[[], bool]], Coroutine[Any, Any, None]]
) -> None:
    """Measure the offset of another process's monotonic clock, unless the process is lost."""
    for _ in range(KEPT):
        count = member.exchanges.count
        ask(member)
        await until(lambda n=count: member.over != "" or member.exchanges.count > n)  # type: ignore[misc]


def ask(member: Member) -> None:
    """Ask another process for its time."""
    member.outbox.send(Ping(time.monotonic_ns()))


class PhaseLockedLoop:
    """How quickly to run to catch up with a clock: a phase-locked loop of the second order.

    It is critically damped and settles in half a minute. (As in RFC 5905, section 11.3.) `drift` is
    how much quicker the other clock is, as far as is known.
    """

    PROPORTIONAL = 0.2  # a second
    INTEGRAL = PROPORTIONAL**2 / 4

    def __init__(self) -> None:
        self.drift = 0.0

    def factor(self, late: float, seconds: float) -> float:
        """Return how quickly to run from here on, `late` seconds behind."""
        drift = self.drift + self.INTEGRAL * late * seconds
        wanted = drift + self.PROPORTIONAL * late
        if abs(wanted) < LIMIT:  # else this is more than drift
            self.drift = drift
        return 1.0 + min(max(wanted, -LIMIT), LIMIT)


class ClockFollower:
    """Follower of another process's clock, by steering ours."""

    def __init__(self, clock: RealClock, member: Member) -> None:
        self.member = member
        self._clock = clock
        self._pursuit = PhaseLockedLoop()
        self._loop = asyncio.get_running_loop()
        self._asked = 0
        self._handle = self._loop.call_later(PERIOD, self._ask)

    def stop(self) -> None:
        """Look no more."""
        self._handle.cancel()

    def go_on_alone(self) -> None:
        """Look no more, and run as quickly as the other clock did."""
        self.stop()
        self._clock.steer(1.0 + self._pursuit.drift)

    def _ask(self) -> None:
        ask(self.member)
        self._asked += 1
        if self._asked % EXCHANGES == 0:
            self._steer()
        self._handle = self._loop.call_later(PERIOD, self._ask)

    def _steer(self) -> None:
        best = self.member.exchanges.best(EXCHANGES - 1)  # the last was asked for just now
        if best is not None:
            late = best.late / self._clock.speed / SECOND
            self._clock.steer(self._pursuit.factor(late, PERIOD * EXCHANGES))
            self.member.drift_ppm = self._pursuit.drift * 1e6
