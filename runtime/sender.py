"""The sending end of an output: one loop over a frozen tuple of listeners.

Delivery is synchronous: when `send` returns, every handler has run and every waiting reader has
been resumed. Who listens is decided by `runtime.graph` before the first event.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from typing import Any, Generic, TypeVar

from events import Event
from runtime.errors import ChannelClosedError, ChannelThreadError, ChannelTypeError
from runtime.streams import Stream
from runtime.tasks import FanOut, Fault

T = TypeVar("T", bound=Event)

Deliver = Callable[[Any], Any]
"""A handler, or a stream's `offer`; a true result ends the delivery."""

Tap = Callable[["Sender[Any] | None", Event], None]
"""Sees every event before its listeners do: the digest, the event log. (An announcement has no
sender.)"""


class Sender(Generic[T]):
    """An output of one node.

    Args:
        name: ``node.port``.
        event: The declared type of event.
        outside: What its node does in threads just now. While there is something, each event is
            checked to be sent by the loop's thread; else the first only.
    """

    __slots__ = (
        "_candidates",
        "_deliver",
        "_expected",
        "_fault",
        "_known",
        "_listeners",
        "_outside",
        "_routes",
        "_sent",
        "_taps",
        "_thread",
        "_to_streams",
        "_waiting",
        "event",
        "name",
        "send",
    )

    def __init__(self, name: str, event: type[T], outside: Collection[Any] = ()) -> None:
        self.name = name
        self.event = event
        self._outside = outside
        self._thread = 0
        self._expected: type[T] | None = None
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
        self, candidates: Iterable[Listener], taps: Iterable[Tap] = (), fault: Fault | None = None
    ) -> None:
        """Freeze who listens, in order, and pick the shortest way to deliver to them."""
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
        """Check the next event, and all after it while the node does something in a thread."""
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
        """Raise if this cannot be sent, or not from here; else see to it that the next is quick."""
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
        if not self._outside:
            self._expected = self._to_streams.expected = self.event

    def _send_to_all(self, event: T) -> bool:
        if event.__class__ is not self._expected:
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
        if event.__class__ is not self._expected:
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
        """Count what was sent, by type."""
        counts: Counter[type[Event]] = Counter({self.event: self._sent + self._to_streams.sent})
        for route in self._known.values():
            counts[route.key[0]] += route.sent
        return +counts

    def _go_on(
        self, listeners: tuple[Deliver, ...], failed: Deliver, error: BaseException, event: T
    ) -> bool:
        """Report the listener that raised, and deliver to those after it."""
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
    """One handler or stream, and which events it receives.

    Args:
        node: Name of the node it belongs to.
        deliver: What to call with an event.
        events: The types that it receives, with their subclasses.
        source: Only this source and those below it; `None` for all.
        stream: The stream, if it is one.
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
        """Return whether an output of this type can send what this listener receives."""
        return issubclass(event, self.events) or any(issubclass(e, event) for e in self.events)

    def receives_all(self, event: type[Event]) -> bool:
        """Return whether this listener receives all that an output of this type sends."""
        return self.source is None and issubclass(event, self.events)

    def receives(self, event: type[Event], source: str) -> bool:
        """Return whether this listener receives events of this very type from this source."""
        return issubclass(event, self.events) and (
            self.source is None or source == self.source or source.startswith(self.source + "/")
        )


class Route:
    """The listeners to one type of event from one source, and how often it was sent."""

    __slots__ = ("key", "listeners", "sent")

    def __init__(self, key: tuple[type[Event], str], listeners: tuple[Deliver, ...]) -> None:
        self.key = key
        self.listeners = listeners
        self.sent = 0


def _raise(_: Deliver, error: BaseException) -> None:
    """Pass a listener's error on to the sender: the default outside a run."""
    raise error
