"""Causes of events: from a sensor's measurement, through nodes, to a set-point.

Nodes don't declare it, so it is inferred by three rules, the most reliable first:

1. An event has the stamp of one that its node received: an estimate has that of its image.
2. Its node sent it while it handled another event.
3. Its node had received another event: a controller with a rate of its own uses the newest.

The third rule is a guess, and is marked as *held*: the latency of such a path is the age of the
newest event that the node could have used.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Literal

import msgspec

from runtime.tools.tracing.spool import EventKind, EventNote

REMEMBERED = 512  # how many stamps of received events are kept per node
IDENTITIES = 8192  # how many events are kept by identity

How = Literal["begins", "follows", "holds"]


class SentEvent(msgspec.Struct, eq=False):
    """An event and its cause, an earlier event.

    Attributes:
        time: Of `time.perf_counter_ns`, when it was sent.
        node: Sender.
        seen: Whether its path begins with a camera.
        how: ``begins`` a path, ``follows`` from `cause`, or ``holds`` it at best.
        cause: The event that it follows from.
    """

    time: int
    run: int
    node: str
    event: str
    source: str
    stamp: int
    seen: bool = False
    how: How = "begins"
    cause: SentEvent | None = None

    def path(self) -> list[SentEvent]:
        """Return all events from the sensor's event to this."""
        found: list[SentEvent] = []
        each: SentEvent | None = self
        while each is not None:
            found.append(each)
            each = each.cause
        return found[::-1]


class _HeardEvents:
    def __init__(self) -> None:
        self.by_stamp: OrderedDict[int, list[SentEvent]] = OrderedDict()
        self.newest: SentEvent | None = None

    def add(self, sent: SentEvent) -> None:
        self.by_stamp.setdefault(sent.stamp, []).append(sent)
        if len(self.by_stamp) > REMEMBERED:
            self.by_stamp.popitem(last=False)
        if sent.seen or self.newest is None or not self.newest.seen:
            self.newest = sent

    def of_stamp(self, stamp: int) -> Iterator[SentEvent]:
        """Yield the events with this stamp, the most likely cause first."""
        yield from sorted(
            self.by_stamp.get(stamp, ()), key=lambda s: (s.seen, s.time), reverse=True
        )


class Causes:
    """Inference of each event's cause, event by event in the order of sending.

    Args:
        receivers: The nodes that receive events of a sender, type and source.
    """

    def __init__(
        self,
        kinds: Mapping[str, EventKind],
        receivers: Mapping[tuple[str, str, str], tuple[str, ...]],
    ) -> None:
        self._kinds = kinds
        self._receivers = receivers
        self._heard: dict[str, _HeardEvents] = {}
        self._by_identity: OrderedDict[int, tuple[SentEvent, tuple[str, ...]]] = OrderedDict()
        """Events with their receiving nodes, by `id`."""

    def add(self, note: EventNote) -> SentEvent:
        """Add the next event, and return the event with its cause."""
        node, kind = note.sender.partition(".")[0], self._kinds[note.event]
        sent = SentEvent(note.time, note.run, node, note.event, note.source, note.stamp)
        # Another event may lie where one lay that has come from elsewhere.
        found, heard = self._by_identity.get(note.given, (None, ()))
        self._trace_back(sent, kind, found if node in heard else None)
        sent.seen = kind.image if sent.cause is None else sent.cause.seen
        receivers = self._receivers.get((note.sender, note.event, note.source), ())
        self._by_identity[note.identity] = sent, receivers
        self._by_identity.move_to_end(note.identity)
        if len(self._by_identity) > IDENTITIES:
            self._by_identity.popitem(last=False)
        if not kind.setpoint and (kind.measured or sent.cause is not None):
            for receiver in receivers:
                if receiver != node:
                    self._heard.setdefault(receiver, _HeardEvents()).add(sent)
        return sent

    def _trace_back(self, sent: SentEvent, kind: EventKind, given: SentEvent | None) -> None:
        past = self._heard.get(sent.node) or _HeardEvents()
        if given is not None and (given.node == sent.node or not self._leads_anywhere(given)):
            given = None
        followed: list[SentEvent] = []
        if not kind.setpoint:  # whose stamp is when it was sent, and tells nothing
            if given is not None and given.stamp == sent.stamp:
                followed.append(given)
            followed += past.of_stamp(sent.stamp)
        if given is not None and not kind.measured:
            followed.append(given)
        for cause in followed:
            if _passes(cause, sent.node):
                sent.cause, sent.how = cause, "follows"
                return
        newest = past.newest
        if newest is not None and not kind.measured and _passes(newest, sent.node):
            sent.cause, sent.how = newest, "holds"

    def _leads_anywhere(self, sent: SentEvent) -> bool:
        kind = self._kinds[sent.event]
        return not kind.setpoint and (kind.measured or sent.cause is not None)


def _passes(sent: SentEvent, node: str) -> bool:
    """Tell whether a path can go on to a node: each node is on a path only once."""
    return all(each.node != node for each in sent.path())
