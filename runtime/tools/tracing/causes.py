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


class Said(msgspec.Struct, eq=False):
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
    cause: Said | None = None

    def path(self) -> list[Said]:
        """Return all events from the sensor's to this one."""
        found: list[Said] = []
        each: Said | None = self
        while each is not None:
            found.append(each)
            each = each.cause
        return found[::-1]


class _Past:
    """What a node has heard that comes from a sensor."""

    def __init__(self) -> None:
        self.by_stamp: OrderedDict[int, list[Said]] = OrderedDict()
        self.newest: Said | None = None

    def add(self, said: Said) -> None:
        self.by_stamp.setdefault(said.stamp, []).append(said)
        if len(self.by_stamp) > REMEMBERED:
            self.by_stamp.popitem(last=False)
        if said.seen or self.newest is None or not self.newest.seen:
            self.newest = said

    def of_stamp(self, stamp: int) -> Iterator[Said]:
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
        self._by_identity: OrderedDict[int, tuple[Said, tuple[str, ...]]] = OrderedDict()
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
    ) -> Said:
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
        said = Said(time, run, node, event, source, stamp)
        # Another event may lie where one lay that has come from elsewhere.
        found, heard = self._by_identity.get(given, (None, ()))
        self._trace_back(said, kind, found if node in heard else None)
        said.seen = kind.seen if said.cause is None else said.cause.seen
        hearers = self._hearers.get((sender, event, source), ())
        self._by_identity[identity] = said, hearers
        self._by_identity.move_to_end(identity)
        if len(self._by_identity) > IDENTITIES:
            self._by_identity.popitem(last=False)
        if not kind.asked and (kind.sensed or said.cause is not None):
            for hearer in hearers:
                if hearer != node:
                    self._pasts.setdefault(hearer, _Past()).add(said)
        return said

    def _trace_back(self, said: Said, kind: Kind, given: Said | None) -> None:
        past = self._pasts.get(said.node) or _Past()
        if given is not None and (given.node == said.node or not self._leads_anywhere(given)):
            given = None
        followed: list[Said] = []
        if not kind.asked:  # whose stamp is when it was sent, and tells nothing
            if given is not None and given.stamp == said.stamp:
                followed.append(given)
            followed += past.of_stamp(said.stamp)
        if given is not None and not kind.sensed:
            followed.append(given)
        for cause in followed:
            if _passes(cause, said.node):
                said.cause, said.how = cause, "follows"
                return
        newest = past.newest
        if newest is not None and not kind.sensed and _passes(newest, said.node):
            said.cause, said.how = newest, "holds"

    def _leads_anywhere(self, said: Said) -> bool:
        kind = self._kinds[said.event]
        return not kind.asked and (kind.sensed or said.cause is not None)


def _passes(said: Said, node: str) -> bool:
    """Tell whether a path can go on to a node: it goes through none twice."""
    return all(each.node != node for each in said.path())
