"""Another process, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable

from events import Event
from runtime.errors import VisnavError, WireError
from runtime.peers.authentication import Sealing
from runtime.peers.clock_offsets import Exchanges
from runtime.peers.messages import (
    Ack,
    Announcements,
    EventMessage,
    FirstUpdate,
    Hello,
    OfTheRun,
)
from runtime.peers.outbox import Outbox, Put
from runtime.peers.shared_memory import Incoming, Outgoing
from runtime.summary import ProcessSummary, Summary
from runtime.wire import unpack

ACK_EVERY = 8192
"""Bytes after which the other end is notified that they have arrived."""

FREE_EVERY = 4
"""Frames in its memory, read no more, after which it is notified."""


class Member:
    """Another process, for as long as a session with it lasts.

    Args:
        id_: By which it is known.
        hello: How it describes itself.
        sealing: What proves that a message is its own.
        put: Writes a message to it; may wait.
        failed: Called with what could not be written.

    Attributes:
        number: Its number among the processes of the run, or -1 if it is none of them.
        over: Why the session has ended, if it has.
        lost_at: When it ended, on `time.monotonic`.
        running: Whether its first update was already, as far as is known.
        unfit: Whether it is no part of the run: it runs another file, or nodes that run elsewhere.
        held: Messages it has sent, while another process with its nodes is still in the run.
        exchanges: Of the time.
        drift_ppm: How much quicker that clock is than ours, in millionths, if we follow it.
        announced: What its nodes announced.
        ready: Whether its nodes can begin.
        begin: When the first update is, if it has sent that.
        final_summary: Its part of the run's summary.
        outgoing: Memory that was offered to it.
        incoming: Memory of its own that we see.
        has_our_summary: Whether it has our part of the run's summary.
    """

    def __init__(
        self,
        id_: str,
        hello: Hello,
        sealing: Sealing,
        put: Put,
        failed: Callable[[VisnavError], None],
    ) -> None:
        self.id = id_
        self.hello = hello
        self.sealing = sealing
        self.number = -1
        self.over = ""
        self.lost_at = 0.0
        self.running = hello.running
        self.unfit = True
        self.held: list[tuple[OfTheRun, Event | None]] | None = None
        self.exchanges = Exchanges()
        self.drift_ppm: float | None = None
        self.announced: Announcements | None = None
        self.ready = False
        self.begin: FirstUpdate | None = None
        self._arrived = 0
        self.final_summary: Summary | None = None
        self.outgoing: Outgoing | None = None
        self.incoming: Incoming | None = None
        self.has_our_summary = False
        self.outbox = Outbox(
            id_, lambda message, payload: put(sealing.seal(message, payload), payload), failed
        )

    def event(self, message: EventMessage, payload: bytes) -> Event:
        """Return the event that it sent.

        Raises:
            WireError: There is none that is known here.
        """
        if message.place is None:
            return unpack(payload)
        if self.incoming is None:
            raise WireError("expected an event as a payload, found its place in unknown memory")
        return unpack(self.incoming.frame(*message.place))

    def acknowledge(self, count: int) -> None:
        """Take in that so many bytes came, and notify it once in a while."""
        self._arrived += count
        unread = 0 if self.incoming is None else self.incoming.unread
        if self._arrived >= ACK_EVERY or unread >= FREE_EVERY:
            freed = () if self.incoming is None else self.incoming.freed()
            self.outbox.send(Ack(self._arrived, freed))
            self._arrived = 0

    def acknowledged(self, ack: Ack) -> None:
        """Take in what it has got, and what it reads no more."""
        self.outbox.arrived(ack.arrived)
        if self.outgoing is not None:
            self.outgoing.freed(ack.freed)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Its nodes, in file order."""
        return self.hello.nodes

    @property
    def place(self) -> str:
        """Where it runs, for messages to people."""
        return self.hello.place

    def summary(self) -> ProcessSummary:
        """Return its entry in the run's summary."""
        best = self.exchanges.best()
        return ProcessSummary(
            nodes=list(self.nodes),
            place=self.place,
            clock_offset_ms=None if best is None else best.offset / 1e6,
            round_trip_ms=None if best is None else best.round_trip / 1e6,
            clock_drift_ppm=self.drift_ppm,
            waited=self.outbox.peak,
            replaced=self.outbox.replaced,
        )
