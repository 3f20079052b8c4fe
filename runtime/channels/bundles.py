"""Declarations of a node's class, and inputs of several events with a common stamp.

A `Bundle` declares that image, depth and pose belong together; at run time a `Matcher` does the
work. A set that is not completed, or that the reader skips, leaves its tuples to the next one. (A
set that is lost by a link before the bundle takes them along.) Stamps rise from set to set: an
event that comes twice, or late, makes no set.
"""

from __future__ import annotations

import types
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import (
    Any,
    Generic,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

from events import Event
from runtime.channels.ports import Input, _Port
from runtime.channels.streams import Overflow, Stream, StreamStatistics
from runtime.errors import AmbiguousSourceError, DeclarationError
from runtime.time.clock import SECOND

B = TypeVar("B", bound=tuple[Any, ...])

Kind = Literal["one", "maybe", "all"]

HISTORY = 256  # most events of a field waiting for their partners; beyond, the oldest is dropped

WAITING_BYTES = 64 << 20
"""Most bytes of arrays in these events, but at least 1 event; the first limit counts."""

GATHERED = 16_384  # most events of a field gathering a tuple


class Field(NamedTuple):
    """Field of a set: its event type, and whether required, optional or gathered."""

    event: type[Event]
    kind: Kind


class Bundle(_Port, Generic[B]):
    """An input of several events, matched by stamp and read as sets.

    ::

        class Frame(NamedTuple):
            image: Image                 # the first field sets the stamp
            depth: DepthImage            # required
            pose: PoseStamped | None     # taken if it has arrived with the others, else None
            imu: tuple[Imu, ...]         # all since the previous set, up to this stamp

        frames = Bundle(Frame, keep="latest")

        async for image, depth, pose, imu in self.frames: ...

    On an instance this is a `Matcher`. In the file, ``inputs = { frames = "drone/front" }`` narrows
    all fields but the tuples to one source, and ``"frames.imu" = "drone/imu"`` one field. The
    arguments not named here are as for `Input`, of whole sets.

    Args:
        tolerance: Seconds by which stamps may differ from the first field's; the nearest is taken.
        overflow: ``error`` or ``drop_oldest``: what happens to one more set than `bound`.
        source: Take only events of this source or below it (tuples apart).

    Raises:
        DeclarationError: The fields are no events, or the arguments contradict each other.
    """

    def __init__(
        self,
        set_type: type[B],
        *,
        tolerance: float = 0.0,
        keep: Literal["every", "latest"] = "every",
        bound: int = 64,
        overflow: Literal["error", "drop_oldest"] = "error",
        wake: Literal["now", "soon"] = "now",
        source: str | None = None,
    ) -> None:
        self.fields = _fields(set_type)
        if not tolerance >= 0:
            raise DeclarationError(f"Bundle: tolerance: expected at least 0 s, found {tolerance}")
        first = next(iter(self.fields.values())).event
        policy = Input(first, keep=keep, bound=bound, overflow=overflow, wake=wake)  # checks them
        self.bound = policy.bound
        self.overflow: Overflow = policy.overflow
        self.soon = policy.soon
        self.set_type = set_type
        self.tolerance = round(tolerance * SECOND)
        self.source = source

    @overload
    def __get__(self, node: None, owner: type) -> Bundle[B]: ...
    @overload
    def __get__(self, node: object, owner: type) -> Matcher[B]: ...
    def __get__(self, node: object | None, owner: type) -> Bundle[B] | Matcher[B]:
        """Return the declaration; an instance's matcher stands in the instance itself."""
        return self._declaration(node, owner)

    def make(self, node: str) -> Matcher[B]:
        """Return a new matcher for the node of this name."""
        name = f"{node}.{self.name}"
        stream: Stream[B] = Stream(name, self.bound, self.overflow, self.soon)
        return Matcher(stream, self.set_type, self.fields, self.tolerance)


class Matcher(Generic[B]):
    """Matcher of events by stamp, and holder of the sets for their reader.

    Args:
        tolerance: Nanoseconds by which stamps may differ.

    Attributes:
        missed: Number of sets not completed, by field: its event was missing, or (of the first
            field) not later than that of the set before.
    """

    def __init__(
        self, stream: Stream[B], set_type: type[B], fields: dict[str, Field], tolerance: int
    ) -> None:
        self.name = stream.name
        self.stream = stream
        self.deliver: Callable[[B], Any] = stream.offer
        self.slots = {name: Slot(self, name, field.kind) for name, field in fields.items()}
        self.missed = dict.fromkeys(fields, 0)
        self._set_type = set_type
        self._tolerance = tolerance
        self._newest: int | None = None
        self._first, *self._others = self.slots.values()
        self._tuples = [at for at, slot in enumerate(self.slots.values()) if slot.kind == "all"]
        if self._tuples:
            stream.merge = self._with_tuples_of

    def __aiter__(self) -> AsyncIterator[B]:
        return aiter(self.stream)

    async def __anext__(self) -> B:
        return await anext(aiter(self.stream))

    async def receive(self) -> B:
        """Return the next set, waiting if necessary; see `Stream.receive`."""
        return await self.stream.receive()

    def receive_nowait(self) -> B:
        """Return the next set, neither waiting nor preparing; see `Stream.receive_nowait`."""
        return self.stream.receive_nowait()

    def close(self) -> None:
        """End the stream of sets."""
        self.stream.close()

    def statistics(self) -> StreamStatistics:
        """Return fill level, peak and number of dropped sets of the stream."""
        return self.stream.statistics()

    def match(self) -> None:
        """Deliver all decided sets; called after each new event."""
        first = self._first.events
        while first:
            if self._newest is not None and first[0].stamp <= self._newest:
                self._first.pop()
                self.missed[self._first.field] += 1
                continue
            parts: list[Any] = [first[0]]
            missing = None
            for slot in self._others:
                part = slot.find(first[0].stamp, self._tolerance)
                if part is _WAIT:
                    if not self._first.is_full():
                        return
                    part = None
                if part is None and slot.kind != "maybe":
                    missing = slot.field
                    break
                parts.append(part)
            stamp = self._first.pop().stamp
            for slot in self._others:
                if missing is None or slot.kind != "all":
                    slot.forget(stamp, self._tolerance)
            if missing is None:
                self._newest = stamp
                self.deliver(self._set_type._make(parts))  # type: ignore[attr-defined]
            else:
                self.missed[missing] += 1

    def _with_tuples_of(self, skipped: B, following: B) -> B:
        parts = list(following)
        for at in self._tuples:
            parts[at] = (*skipped[at], *parts[at])[-GATHERED:]
        return self._set_type._make(parts)  # type: ignore[attr-defined,no-any-return]


class Slot:
    """Events of a field waiting for their partners."""

    __slots__ = ("_bytes", "_matcher", "_most", "_source", "events", "field", "kind", "name")

    def __init__(self, matcher: Matcher[Any], field: str, kind: Kind) -> None:
        self.name = f"{matcher.name}.{field}"
        self.field = field
        self.kind = kind
        self.events: deque[Any] = deque()
        self._most = GATHERED if kind == "all" else HISTORY
        self._bytes = 0
        self._matcher = matcher
        self._source: str | None = None

    def add(self, event: Event) -> None:
        """Keep an event, and deliver the sets completed by its arrival.

        Of two sources of which one is below the other (``drone/front/grey``), the upper one counts.

        Raises:
            AmbiguousSourceError: Another source has sent events for this field.
        """
        if event.source != self._source and not self._changes_to(event.source):
            return
        self.events.append(event)
        self._bytes += _size(event)
        self._matcher.match()  # which gives up what is first in the first field if that is full
        while self.is_full():
            self.pop()

    def is_full(self) -> bool:
        """Return whether there is no room for another event."""
        count = len(self.events)
        return count >= self._most or (self._bytes >= WAITING_BYTES and count > 1)

    def pop(self) -> Any:
        """Let go of the oldest."""
        event = self.events.popleft()
        self._bytes -= _size(event)
        return event

    def _changes_to(self, source: str) -> bool:
        """Switch to a source if the first or above the current; return whether switched."""
        before = self._source
        if before is not None and source.startswith(f"{before}/"):
            return False
        if before is not None and not before.startswith(f"{source}/"):
            port = self.name.partition(".")[2]
            raise AmbiguousSourceError(
                f"{self.name}: expected events of one source, found {before!r} and {source!r}: "
                f'name one in the node\'s table, inputs = {{ "{port}" = "{before}" }}'
            )
        self._source = source
        return True

    def find(self, stamp: int, tolerance: int) -> Any:
        """Return the match for a stamp; `None` if there is none, `_WAIT` if still possible."""
        events = self.events
        if self.kind == "all":
            if not events or events[-1].stamp < stamp:
                return _WAIT
            return tuple(e for e in events if e.stamp <= stamp)
        best, distance, later = None, tolerance, False
        for event in events:
            gap = event.stamp - stamp
            later = later or gap >= 0
            if abs(gap) <= distance and (best is None or abs(gap) < distance):
                best, distance = event, abs(gap)
        if distance == 0 and best is not None:
            return best
        if later or self.kind == "maybe":
            return best
        return _WAIT

    def forget(self, stamp: int, tolerance: int) -> None:
        """Drop events too old for any later set."""
        events = self.events
        limit = stamp if self.kind == "all" else stamp - tolerance
        while events and events[0].stamp <= limit:
            self.pop()


def _size(event: Event) -> int:
    fields = event.__struct_fields__
    return sum(getattr(getattr(event, field), "nbytes", 0) for field in fields)


_WAIT: Any = object()


def _fields(set_type: Any) -> dict[str, Field]:
    if not (isinstance(set_type, type) and hasattr(set_type, "_fields")):
        raise DeclarationError(f"Bundle: expected a NamedTuple of events, found {set_type!r}")
    hints = get_type_hints(set_type)
    fields = {name: _field(f"{set_type.__name__}.{name}", hints[name]) for name in hints}
    if not fields or next(iter(fields.values())).kind != "one":
        raise DeclarationError(
            f"Bundle: {set_type.__name__}: expected an event as first field: it sets the stamp"
        )
    return fields


def _field(where: str, hint: Any) -> Field:
    inner, kind = hint, "one"
    if get_origin(hint) in {Union, types.UnionType}:
        inner = next((a for a in get_args(hint) if a is not type(None)), None)
        kind = "maybe" if len(get_args(hint)) == 2 and type(None) in get_args(hint) else "?"
    elif get_origin(hint) is tuple:
        inner, kind = get_args(hint)[0], "all" if get_args(hint)[1:] == (...,) else "?"
    if kind == "?" or not (isinstance(inner, type) and issubclass(inner, Event)):
        raise DeclarationError(
            f"Bundle: {where}: expected an event E, E | None or tuple[E, ...], found {hint}"
        )
    return Field(inner, kind)  # type: ignore[arg-type]
