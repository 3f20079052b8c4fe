"""Which event led to which: from a sensor's, over what nodes made of it, to a set-point.

No node says so, but three things tell, in this order of trust:

1. an event has the stamp of one that its node heard: an estimate bears that of its image;
2. its node sent it while it was given another event;
3. its node had heard another event: a controller that works at a rate of its own takes the newest.

The third is no proof, and is marked as *held*: the latency of such a path is the age of the
newest that the node could know.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Literal

import msgspec

from runtime.tools.tracing.spool import Kind

REMEMBERED = 512
"""Stamps that a node's past goes back."""

IDENTITIES = 8192
"""Events that can be found again by their identity."""

How = Literal["begins", "follows", "holds"]


class SentEvent(msgspec.Struct, eq=False):
    """One event, and what it came from.

    Attributes:
        time: Of `time.perf_counter_ns`, when it was sent.
        run: The same on the run's clock (ns).
        node: That sent it.
        event: Its type.
        source: Its source.
        stamp: Its stamp.
        seen: Whether its path begins with a camera.
        how: ``begins`` a path, ``follows`` from `cause`, or ``holds`` it at best.
        cause: What it came from.
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
        """Return all events from the sensor's to this one."""
        found: list[SentEvent] = []
        each: SentEvent | None = self
        while each is not None:
            found.append(each)
            each = each.cause
        return found[::-1]


class _Past:
    """What a node has heard that comes from a sensor."""

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
        """Yield what was heard with this stamp, the best to build on first."""
        yield from sorted(
            self.by_stamp.get(stamp, ()), key=lambda s: (s.seen, s.time), reverse=True
        )


class Causes:
    """Follows events through the nodes, one by one in the order of sending.

    Args:
        kinds: What is known of types of events.
        hearers: Who hears events of a sender, type and source.
    """

    def __init__(
        self, kinds: Mapping[str, Kind], hearers: Mapping[tuple[str, str, str], tuple[str, ...]]
    ) -> None:
        self._kinds = kinds
        self._hearers = hearers
        self._pasts: dict[str, _Past] = {}
        self._by_identity: OrderedDict[int, tuple[SentEvent, tuple[str, ...]]] = OrderedDict()
        """Events, and who heard them."""

    def add(
        self,
        time: int,
        run: int,
        sender: str,
        event: str,
        source: str,
        stamp: int,
        identity: int,
        given: int,
    ) -> SentEvent:
        """Take the next event and return it with what it came from.

        Args:
            time: Of sending, real time (ns).
            run: Of sending, the run's clock (ns).
            sender: ``node.port``.
            event: Its type.
            source: Its source.
            stamp: Its stamp.
            identity: Its `id`.
            given: The `id` of what the step that sent it had been given; 0 if nothing.
        """
        node, kind = sender.partition(".")[0], self._kinds[event]
        sent = SentEvent(time, run, node, event, source, stamp)
        # Another event may lie where one lay that has come from elsewhere.
        found, heard = self._by_identity.get(given, (None, ()))
        self._trace_back(sent, kind, found if node in heard else None)
        sent.seen = kind.seen if sent.cause is None else sent.cause.seen
        hearers = self._hearers.get((sender, event, source), ())
        self._by_identity[identity] = sent, hearers
        self._by_identity.move_to_end(identity)
        if len(self._by_identity) > IDENTITIES:
            self._by_identity.popitem(last=False)
        if not kind.asked and (kind.sensed or sent.cause is not None):
            for hearer in hearers:
                if hearer != node:
                    self._pasts.setdefault(hearer, _Past()).add(sent)
        return sent

    def _trace_back(self, sent: SentEvent, kind: Kind, given: SentEvent | None) -> None:
        past = self._pasts.get(sent.node) or _Past()
        if given is not None and (given.node == sent.node or not self._leads_anywhere(given)):
            given = None
        followed: list[SentEvent] = []
        if not kind.asked:  # whose stamp is when it was sent, and tells nothing
            if given is not None and given.stamp == sent.stamp:
                followed.append(given)
            followed += past.of_stamp(sent.stamp)
        if given is not None and not kind.sensed:
            followed.append(given)
        for cause in followed:
            if _passes(cause, sent.node):
                sent.cause, sent.how = cause, "follows"
                return
        newest = past.newest
        if newest is not None and not kind.sensed and _passes(newest, sent.node):
            sent.cause, sent.how = newest, "holds"

    def _leads_anywhere(self, sent: SentEvent) -> bool:
        kind = self._kinds[sent.event]
        return not kind.asked and (kind.sensed or sent.cause is not None)


def _passes(sent: SentEvent, node: str) -> bool:
    """Tell whether a path can go on to a node: it goes through none twice."""
    return all(each.node != node for each in sent.path())
