"""Sending end of an output: a single loop over a frozen tuple of listeners; and imperfect links.

Delivery is synchronous: when `send` returns, every handler has run and every waiting reader has
been resumed. Who listens is decided by `runtime.run.graph` before the first event.

An imperfect link delays, loses or thins out events, in the run's own time::

    [nodes.links.frames]
    delay = "80ms"
    jitter = "5ms"
    loss = 0.02
    rate = 10

Any input, handler, bundle, or field of a bundle may have one. Its effect depends on the run's
seed and the names of node and port only.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from types import FrameType
from typing import Annotated, Any, Generic, TypeVar

import msgspec
import numpy as np

from events import Announcement, Event
from runtime.channels.streams import Stream
from runtime.channels.tasks import FanOut, Fault
from runtime.errors import (
    ChannelClosedError,
    ChannelSourceError,
    ChannelThreadError,
    ChannelTypeError,
    HandlerCircleError,
)
from runtime.time.clock import SECOND, Clock, Once
from runtime.units import Latency

T = TypeVar("T", bound=Event)

Deliver = Callable[[Any], Any]  # a handler, or a stream's `offer`; a true result ends the delivery

Tap = Callable[["Sender[Any] | None", Event], None]
"""Sees every event before its listeners do: the digest, the event log. (An announcement has no
sender.)"""


class Voices:
    """Owners of source names: each node owns its name, its announced sources, and all names below.

    A node that announces ``*`` (a replay does) may send in all names without another owner; those
    in `scripted`, scripts of tests, in any.
    """

    def __init__(self, nodes: Iterable[str], scripted: Collection[str] = ()) -> None:
        self._owners = {name: name for name in nodes}
        self._scripted = frozenset(scripted)
        self._for_others: set[str] = set()
        self._announced: set[tuple[type[Announcement], str]] = set()

    def announce(self, node: str, announcement: Announcement) -> None:
        """Register a node as the owner of an announced source, or raise `ChannelSourceError`."""
        kind, source = type(announcement), announcement.source
        if kind is Announcement and source == "*":
            self._for_others.add(node)
            return
        if node in self._scripted:
            return
        self._check(node, source, f"{kind.__name__} of {source!r}")
        self._owners.setdefault(source, node)
        if kind is not Announcement and (kind, source) in self._announced:
            raise ChannelSourceError(
                f"{node}: expected to announce each source once, found {kind.__name__} of "
                f"{source!r} twice"
            )
        self._announced.add((kind, source))

    def check(self, port: str, event: Event) -> None:
        """Raise an error if an event is sent by ``node.port`` in the name of another."""
        node = port.partition(".")[0]
        if node not in self._scripted and not (
            node in self._for_others and self.owner(event.source) is None
        ):
            self._check(port, event.source, f"{type(event).__name__} of {event.source!r}")

    def owner(self, source: str) -> str | None:
        """Return the owner of a source; `None` if there is none."""
        while source not in self._owners and "/" in source:
            source = source.rpartition("/")[0]
        return self._owners.get(source)

    def _check(self, sender: str, source: str, described: str) -> None:
        """Raise an error unless a source belongs to a sender, ``node`` or ``node.port``."""
        node = sender.partition(".")[0]
        owner = self.owner(source)
        if owner == node or (sender == node and owner is None):
            return
        whose = f"which is {owner}'s" if owner else "which nobody announces"
        raise ChannelSourceError(
            f"{sender}: expected a source that is {node!r}, below it, or announced by this node, "
            f"found {described}, {whose}"
        )


class Sender(Generic[T]):
    """An output of a node.

    Args:
        outside: Work of its node in threads just now. While there is some, each event is checked to
            be sent by the loop's thread; else the first only.
    """

    __slots__ = (
        "_candidates", "_deliver", "_expected", "_fault", "_known", "_listeners", "_outside",
        "_routes", "_sent", "_source", "_taps", "_thread", "_to_streams", "_voices",
        "_waiting", "event", "name", "send", "sources",
    )  # fmt: skip

    def __init__(self, name: str, event: type[T], outside: Collection[Any] = ()) -> None:
        self.name = name
        self.event = event
        self._outside = outside
        self._thread = 0
        self._expected: type[T] | None = None
        self._source = ""  # of the event that was checked last
        self.sources: set[str] = set()
        """Sources of all events sent so far."""
        self._voices: Voices | None = None
        self._sent = 0
        self.send: Callable[[T], bool] = self._refuse
        """Deliver an event now; True if a handler ended the delivery."""
        self._deliver: Callable[[T], bool] = self._refuse
        self._listeners: tuple[Deliver, ...] = ()
        self._to_streams = FanOut(())
        self._candidates: tuple[Listener, ...] = ()
        self._known: dict[tuple[type[Event], str], Route] = {}
        self._routes: dict[tuple[type[Event], str], Route] = {}  # those that need no check
        self._waiting: tuple[Stream[Any], ...] = ()
        self._taps: tuple[Tap, ...] = ()
        self._fault: Fault = _raise

    def connect(
        self,
        candidates: Iterable[Listener],
        taps: Iterable[Tap] = (),
        fault: Fault | None = None,
        voices: Voices | None = None,
    ) -> None:
        """Freeze the listeners in their order, and pick the shortest way of delivery.

        Without `voices`, events may be of any source.
        """
        self._voices = voices
        self._candidates = tuple(c for c in candidates if c.may_receive(self.event))
        self._listeners = tuple(c.deliver for c in self._candidates)
        for route in self._known.values():
            route.listeners = self._listeners_of(*route.key)
        self._waiting = tuple(
            c.stream
            for c in self._candidates
            if c.stream is not None and c.stream.overflow == "wait"
        )
        self._taps = tuple(taps)
        self._fault = fault or _raise
        self._deliver = self._send_routed
        if not self.event.__subclasses__() and all(
            c.receives_all(self.event) for c in self._candidates
        ):
            self._deliver = self._send_to_all
            streams = tuple(c.stream for c in self._candidates if c.stream and not c.stream.soon)
            if streams and len(streams) == len(self._candidates):
                fan_out = FanOut(streams, self._fault, self._check)
                self._to_streams, before = fan_out, self._to_streams
                self._to_streams.sent = before.sent
                self._deliver = self._to_streams.send
        self.send = self._send_tapped if self._taps else self._deliver
        self._thread = threading.get_ident()
        self.watch()

    def watch(self) -> None:
        """Check the next event, and all further events while the node works in a thread."""
        self._expected = self._to_streams.expected = None
        self._routes = {}

    def send_soon(self, event: T) -> None:
        """Deliver an event when the loop next turns; the sender goes on at once."""
        asyncio.get_running_loop().call_soon(lambda: self.send(event))

    async def send_wait(self, event: T) -> bool:
        """Wait until every input declared with ``overflow="wait"`` has room, then send."""
        while not all(stream.has_room() for stream in self._waiting):
            for stream in self._waiting:
                await stream.wait_for_room()
        return self.send(event)

    def _check(self, event: T) -> None:
        if not isinstance(event, self.event):
            raise ChannelTypeError(
                f"{self.name}: expected events of type {self.event.__name__}, "
                f"found {event!r:.80} ({type(event).__name__})"
            )
        if threading.get_ident() != self._thread:
            raise ChannelThreadError(
                f"{self.name}: expected send() in the loop's thread, found it in "
                f"{threading.current_thread().name!r}: return the event from the function and send "
                f"it after the await, or use loop.call_soon_threadsafe({self.name}.send, event)"
            )
        if event.source not in self.sources:
            if self._voices is not None:
                self._voices.check(self.name, event)
            self.sources.add(event.source)
        self._source = self._to_streams.source = event.source
        if not self._outside:
            self._expected = self._to_streams.expected = self.event

    def _send_to_all(self, event: T) -> bool:
        if event.__class__ is not self._expected or event.source is not self._source:
            self._check(event)
        self._sent += 1
        listeners = self._listeners  # a listener may connect anew meanwhile
        try:
            for deliver in listeners:
                if deliver(event):
                    return True
        except BaseException as error:  # none of it is the sender's
            return self._go_on(listeners, deliver, error, event)
        return False

    def _send_routed(self, event: T) -> bool:
        try:
            route = self._routes[type(event), event.source]
        except (KeyError, AttributeError):
            route = self._route(event)
        route.sent += 1
        listeners = route.listeners
        try:
            for deliver in listeners:
                if deliver(event):
                    return True
        except BaseException as error:  # none of it is the sender's
            return self._go_on(listeners, deliver, error, event)
        return False

    def _send_tapped(self, event: T) -> bool:
        if event.__class__ is not self._expected or event.source not in self.sources:
            self._check(event)
        for tap in self._taps:
            tap(self, event)
        return self._deliver(event)

    def _route(self, event: T) -> Route:
        """Check an event, and remember the listeners to its type and source."""
        self._check(event)
        key = type(event), event.source
        if key not in self._known:
            self._known[key] = Route(key, self._listeners_of(*key))
        if not self._outside:
            self._routes[key] = self._known[key]
        return self._known[key]

    def _listeners_of(self, event: type[Event], source: str) -> tuple[Deliver, ...]:
        return tuple(c.deliver for c in self._candidates if c.receives(event, source))

    def sent(self) -> Counter[type[Event]]:
        """Count the sent events by type."""
        counts: Counter[type[Event]] = Counter({self.event: self._sent + self._to_streams.sent})
        for route in self._known.values():
            counts[route.key[0]] += route.sent
        return +counts

    def _go_on(
        self, listeners: tuple[Deliver, ...], failed: Deliver, error: BaseException, event: T
    ) -> bool:
        if isinstance(error, RecursionError):
            if _sends(sys._getframe(2)):
                raise error
            if circle := _circle(error):
                error = HandlerCircleError(
                    "expected handlers that come to an end, found some that answer one another: "
                    + circle
                )
        self._fault(failed, error)
        for deliver in listeners[listeners.index(failed) + 1 :]:
            try:
                if deliver(event):
                    return True
            except BaseException as another:
                self._fault(deliver, another)
        return False

    def _refuse(self, event: T) -> bool:
        raise ChannelClosedError(
            f"{self.name}: {type(event).__name__} sent before the first update; "
            "send from run(), a tick or a handler, or announce it"
        )


class Listener:
    """Handler or stream, with the filter of its events.

    Args:
        events: Types received, with their subclasses.
        source: Only this source and those below it; `None` for all.
    """

    __slots__ = ("deliver", "events", "node", "source", "stream")

    def __init__(
        self,
        node: str,
        deliver: Deliver,
        events: tuple[type[Event], ...],
        source: str | None = None,
        stream: Stream[Any] | None = None,
    ) -> None:
        self.node = node
        self.deliver = deliver
        self.events = events
        self.source = source
        self.stream = stream

    def may_receive(self, event: type[Event]) -> bool:
        """Return whether an output of this type can send events for this listener."""
        return issubclass(event, self.events) or any(issubclass(e, event) for e in self.events)

    def receives_all(self, event: type[Event]) -> bool:
        """Return whether this listener receives all events of an output of this type."""
        return self.source is None and issubclass(event, self.events)

    def receives(self, event: type[Event], source: str) -> bool:
        """Return whether this listener receives events of this very type from this source."""
        return issubclass(event, self.events) and (
            self.source is None or source == self.source or source.startswith(self.source + "/")
        )


class Route:
    """Listeners to an event type from a source, and the number of events sent."""

    __slots__ = ("key", "listeners", "sent")

    def __init__(self, key: tuple[type[Event], str], listeners: tuple[Deliver, ...]) -> None:
        self.key = key
        self.listeners = listeners
        self.sent = 0


_SENDING = {Sender._send_to_all.__code__, Sender._send_routed.__code__}


def _sends(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code not in _SENDING:
        frame = frame.f_back
    return frame is not None


def _circle(error: BaseException) -> str:
    """Return the ports and handlers repeated in an error's traceback, if any."""
    frames: dict[FrameType, None] = {}  # each stands there once for each time it was raised in
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code in _SENDING:
            frames[trace.tb_frame] = None
        trace = trace.tb_next
    steps = []
    for frame in frames:
        deliver = frame.f_locals["deliver"]
        node = getattr(getattr(deliver, "__self__", None), "name", "?")
        handler = getattr(deliver, "__name__", "?")
        steps.append(f"{frame.f_locals['self'].name} → {node}.{handler}")
    if not steps or steps[-1] not in steps[:-1]:
        return ""
    last = len(steps) - 1 - steps[-2::-1].index(steps[-1])
    return ", ".join(sorted(steps[last:], key=steps.index))


def _raise(_: Deliver, error: BaseException) -> None:
    raise error


class LinkConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Imperfections of a link to a port.

    Attributes:
        delay: Delay of every event.
        jitter: Most additional delay, at random; the order is kept.
        loss: Share of events lost, at random.
        rate: Most events a second, by their stamps; 0 for all.
    """

    delay: Latency = Latency(0)  # immutable
    jitter: Latency = Latency(0)
    loss: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    rate: Annotated[float, msgspec.Meta(ge=0)] = 0.0


class Link:
    """Link before a port; delivers each event later, or not at all.

    A handler behind a link with a delay cannot end a delivery: when it is called, the nodes after
    it have had the event.

    Args:
        before: Replaced link, whose figures are carried on.
    """

    def __init__(
        self, name: str, config: LinkConfig, clock: Clock, seed: int, before: Link | None = None
    ) -> None:
        self.name = name
        self.lost: int = before.lost if before else 0
        self.thinned: int = before.thinned if before else 0
        self._config = config
        self._clock = clock
        self._rng = np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(b"link")])
        self._deliver: Callable[[Any], Any] | None = None
        self._fault: Callable[[BaseException], None] = _raise_again
        self._last_period: dict[str, int] = {}  # by source
        self._last_due = 0

    def to(
        self, deliver: Callable[[Any], Any], fault: Callable[[BaseException], None] | None = None
    ) -> Callable[[Any], Any]:
        """Connect the far end to a receiver; return the function to call at this end."""
        self._deliver = deliver
        self._fault = fault or _raise_again
        return self.offer

    def close(self) -> None:
        """Deliver nothing any more: the far end is gone."""
        self._deliver = None

    def offer(self, event: Any) -> bool:
        """Take an event (or a tuple of events, whose first has the stamp)."""
        config = self._config
        if config.rate and self._is_too_soon(event[0] if isinstance(event, tuple) else event):
            self.thinned += 1
            return False
        if config.loss and self._rng.random() < config.loss:
            self.lost += 1
            return False
        delay = float(config.delay)
        if config.jitter:
            delay += float(config.jitter) * self._rng.random()
        if not delay:
            return bool(self._deliver and self._deliver(event))
        due = max(self._clock.now() + round(delay * SECOND), self._last_due)
        self._last_due = due
        self._clock.schedule.add(due, Once(lambda: self._arrive(event)))
        return False

    def _arrive(self, event: Any) -> None:
        try:
            if self._deliver is not None:
                self._deliver(event)
        except BaseException as error:
            self._fault(error)

    def _is_too_soon(self, event: Any) -> bool:
        """Return whether a source already had an event in this period of the rate."""
        period = int(event.stamp * self._config.rate // SECOND)
        if self._last_period.get(event.source) == period:
            return True
        self._last_period[event.source] = period
        return False


def _raise_again(error: BaseException) -> None:
    raise error
