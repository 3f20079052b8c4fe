"""Another process, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable

from runtime.errors import VisnavError
from runtime.peers.line import Line, Put
from runtime.peers.messages import Announced, Begin, Hello, Wanted
from runtime.peers.offsets import Offset
from runtime.summary import ProcessSummary


class Member:
    """Another process.

    Args:
        id_: By which it is known.
        put: Writes a message to it; may wait.
        failed: Told what could not be written.

    Attributes:
        number: Its number among the processes of the run, or -1 if it is none of them.
        hello: Who it says it is.
        unfit: Whether it runs another file, or nodes that run elsewhere.
        offset: Of its monotonic clock.
        announced: What its nodes announced.
        ready: Whether its nodes can begin.
        begin: When the first update is, if it has said so.
        told: What it was told that nodes here hear.
        arrived: Bytes that came from it and that it has not been told of.
        parted: What it had to say of the run, as JSON.
        has_ours: Whether it has what we had to say of the run.
    """

    def __init__(self, id_: str, put: Put, failed: Callable[[VisnavError], None]) -> None:
        self.id = id_
        self.number = -1
        self.hello: Hello | None = None
        self.unfit = False
        self.offset = Offset()
        self.announced: Announced | None = None
        self.ready = False
        self.begin: Begin | None = None
        self.told: tuple[Wanted, ...] | None = None
        self.arrived = 0
        self.parted: bytes | None = None
        self.has_ours = False
        self.line = Line(id_, put, failed)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Its nodes, in file order."""
        return () if self.hello is None else self.hello.nodes

    @property
    def place(self) -> str:
        """Where it runs, for messages to people."""
        return self.id if self.hello is None else self.hello.place

    def summary(self) -> ProcessSummary:
        """Return what the run's summary says of it."""
        trip = self.offset.round_trip
        return ProcessSummary(
            nodes=list(self.nodes),
            place=self.place,
            clock_offset_ms=None if trip is None else self.offset.ns / 1e6,
            round_trip_ms=None if trip is None else trip / 1e6,
            waited=self.line.peak,
            replaced=self.line.replaced,
        )
