"""Sending end of an output: a single loop over a frozen tuple of listeners.

Delivery is synchronous: when `send` returns, every handler has run and every waiting reader has
been resumed. Who listens is decided by `runtime.run.graph` before the first event.
"""

from __future__ import annotations

import asyncio
import sys
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from types import FrameType
from typing import Any, Generic, TypeVar

from events import Event
from runtime.channels.sources import SourceOwners
from runtime.channels.streams import Stream
from runtime.channels.tasks import FanOut, Fault
from runtime.errors import (
    ChannelClosedError,
    ChannelThreadError,
    ChannelTypeError,
    HandlerCircleError,
)

T = TypeVar("T", bound=Event)

Deliver = Callable[[Any], Any]  # a handler, or a stream's `offer`; a true result ends the delivery

Tap = Callable[["Sender[Any] | None", Event], None]
"""Sees every event before its listeners do: the digest, the event log. (An announcement has no
sender.)"""


class Sender(Generic[T]):
    """An output of a node.

    Args:
        outside: Work of its node in threads just now. While there is some, each event is checked to
            be sent by the loop's thread; else the first only.
    """

    __slots__ = (
        "_candidates",
        "_deliver",
        "_expected",
        "_fault",
        "_known",
        "_listeners",
        "_outside",
        "_owners",
        "_routes",
        "_sent",
        "_source",
        "_taps",
        "_thread",
        "_to_streams",
        "_waiting",
        "event",
        "name",
        "send",
        "sources",
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
        self._owners: SourceOwners | None = None
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
        owners: SourceOwners | None = None,
    ) -> None:
        """Freeze the listeners in their order, and pick the shortest way of delivery.

        Without `owners`, events may be of any source.
        """
        self._owners = owners
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
            if self._owners is not None:
                self._owners.check(self.name, event)
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
        deliver = frame.f_locals.get("deliver")
        if deliver is None:  # the innermost one may have got no further
            continue
        node = getattr(getattr(deliver, "__self__", None), "name", "?")
        handler = getattr(deliver, "__name__", "?")
        steps.append(f"{frame.f_locals['self'].name} → {node}.{handler}")
    if not steps or steps[-1] not in steps[:-1]:
        return ""
    last = len(steps) - 1 - steps[-2::-1].index(steps[-1])
    return ", ".join(sorted(steps[last:], key=steps.index))


def _raise(_: Deliver, error: BaseException) -> None:
    raise error
