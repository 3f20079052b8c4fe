"""Another process of the run, and keeping our clock with that of its machine.

Clocks are compared by Cristian's algorithm: a reply that took little time, there and back, cannot
have been read off far from the middle of it. (F. Cristian, Probabilistic clock synchronization,
1989.) Two machines' clocks part by some 20 µs a second. Ours runs a little quicker or slower until
it shows what the other one does, and never jumps.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from events import Event
from runtime.errors import WireError
from runtime.peers import messages
from runtime.peers.authentication import Sealing
from runtime.peers.outbox import Incoming, Outbox, Outgoing
from runtime.summary import ProcessSummary, Summary
from runtime.time.clock import RealClock
from runtime.time.schedule import SECOND
from runtime.wire import unpack

ACK_EVERY = 8192  # received bytes between two acknowledgements
FREE_EVERY = 4  # released frames of the other's memory between two acknowledgements

KEPT = 20  # number of remembered exchanges
PERIOD = 0.1  # seconds between two exchanges
EXCHANGES = 10  # exchanges for each correction of our clock; the quickest gives its lateness

LIMIT = 500e-6
"""Greatest relative change of our clock's rate, as in NTP; quartzes differ by a tenth of this."""


class Exchange(NamedTuple):
    """Result of a question and its answer (ns): `offset` is their monotonic clock minus ours.

    Half of the round trip bounds its error, and that of `late`: their clock of the run minus ours.
    """

    round_trip: int
    offset: int
    late: int


@dataclass(eq=False)
class Member:
    """Another process, for the duration of a session.

    Attributes:
        number: Its number among the processes of the run, or -1 if it is none of them.
        over: Why the session has ended, if it has.
        lost_at: When it ended, on `time.monotonic`.
        running: Whether its first update was already, as far as is known.
        unfit: Whether it is no part of the run: it runs another file, or nodes that run elsewhere.
        held: Messages it has sent, while another process with its nodes is still in the run.
        exchanges: The latest; appended to in any thread.
        drift_ppm: Drift of its clock relative to ours, parts per million, if we follow it.
        begin: When the first update is, if it has sent that.
        returning: Whether it came while the run went on, and is not ready yet.
        outgoing: Memory that was offered to it.
        incoming: Memory of its own that we see.
    """

    id: str
    hello: messages.Hello
    sealing: Sealing
    outbox: Outbox
    number: int = -1
    over: str = ""
    lost_at: float = 0.0
    running: bool = False
    unfit: bool = True
    held: list[tuple[messages.OfTheRun, Event | None]] | None = None
    exchanges: deque[Exchange] = field(default_factory=lambda: deque(maxlen=KEPT))
    drift_ppm: float | None = None
    announced: messages.Announcements | None = None
    ready: bool = False
    begin: messages.FirstUpdate | None = None
    returning: bool = False
    final_summary: Summary | None = None
    has_our_summary: bool = False
    outgoing: Outgoing | None = None
    incoming: Incoming | None = None
    _arrived: int = 0

    def __post_init__(self) -> None:
        self.running = self.hello.running

    @property
    def nodes(self) -> tuple[str, ...]:
        """Its nodes, in file order."""
        return self.hello.nodes

    @property
    def name(self) -> str:
        """Its nodes, in words."""
        return ", ".join(self.nodes)

    @property
    def place(self) -> str:
        """Host and process number, for messages to people."""
        return self.hello.place

    def event(self, message: messages.EventMessage, payload: bytes) -> Event:
        """Return the event of a message, or raise `WireError`."""
        if message.place is None:
            return unpack(payload)
        if self.incoming is None:
            raise WireError("expected an event as a payload, found its place in unknown memory")
        return unpack(self.incoming.frame(*message.place))

    def acknowledge(self, count: int) -> None:
        """Count received bytes, and acknowledge them once in a while."""
        self._arrived += count
        unread = 0 if self.incoming is None else len(self.incoming.freed)
        if self._arrived >= ACK_EVERY or unread >= FREE_EVERY:
            freed = () if self.incoming is None else self.incoming.take_freed()
            self.outbox.send(messages.Ack(self._arrived, freed))
            self._arrived = 0

    def acknowledged(self, ack: messages.Ack) -> None:
        """Handle an acknowledgement: bytes received, and frames read no more."""
        self.outbox.arrived(ack.arrived)
        if self.outgoing is not None:
            self.outgoing.freed.extend(ack.freed)

    def ask_time(self) -> None:
        """Ask for its time; the answer is an `Exchange`."""
        self.outbox.send(messages.Ping(time.monotonic_ns()))

    async def compare_clocks(
        self, until: Callable[[Callable[[], bool]], Coroutine[Any, Any, None]]
    ) -> None:
        """Measure the offset of its monotonic clock, unless it is lost."""
        self.exchanges.clear()
        for count in range(KEPT):
            self.ask_time()
            await until(lambda n=count: self.over != "" or len(self.exchanges) > n)  # type: ignore[misc]

    def best(self, latest: int = KEPT) -> Exchange | None:
        """Return the quickest of the latest exchanges, if there were any."""
        return min(list(self.exchanges)[-latest:], default=None)

    def summary(self) -> ProcessSummary:
        """Return its entry in the run's summary."""
        best = self.best()
        return ProcessSummary(
            nodes=list(self.nodes),
            place=self.place,
            clock_offset_ms=None if best is None else best.offset / 1e6,
            round_trip_ms=None if best is None else best.round_trip / 1e6,
            clock_drift_ppm=self.drift_ppm,
            waited=self.outbox.peak,
            replaced=self.outbox.replaced,
        )


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
        self.member.ask_time()
        self._asked += 1
        if self._asked % EXCHANGES == 0:
            self._steer()
        self._handle = self._loop.call_later(PERIOD, self._ask)

    def _steer(self) -> None:
        best = self.member.best(EXCHANGES - 1)  # the last was asked for just now
        if best is not None:
            late = best.late / self._clock.speed / SECOND
            self._clock.steer(self._pursuit.factor(late, PERIOD * EXCHANGES))
            self.member.drift_ppm = self._pursuit.drift * 1e6
