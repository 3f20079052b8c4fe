"""Declarations of a node's class: inputs, outputs, handlers and ticks.

Declarations are read from the class, so that the graph is known, drawn and checked before
anything runs. Their counterparts at run time are in `runtime.channels.streams`,
`runtime.channels.sender` and `runtime.time.clock`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, overload

import msgspec

from events import Event
from runtime.channels.streams import Overflow, Stream
from runtime.errors import DeclarationError

if TYPE_CHECKING:
    from typing import Self

    from runtime.channels.sender import Sender

T = TypeVar("T", bound=Event)
F = TypeVar("F", bound=Callable[..., Any])


class _Port:
    """Common base of inputs and outputs: a name, and no value before a run."""

    name = "?"

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def _declaration(self, node: object | None, owner: type) -> Self:
        """Return the declaration of a class; raise for an instance outside a run."""
        if node is None:
            return self
        raise AttributeError(f"{owner.__name__}.{self.name} exists once a run has made the node")


class Input(_Port, Generic[T]):
    """An input read by a coroutine: ``async for image in self.images``.

    On an instance this is a `runtime.channels.streams.Stream`.

    Args:
        keep: What may be skipped. ``every``: nothing; up to `bound` events wait, and `overflow`
            says what happens to one more. ``latest``: all but the newest.
        overflow: ``error`` (default), ``drop_oldest``, or ``wait`` for senders that await
            `Sender.send_wait`.
        wake: ``now`` resumes the reader inside `send`; ``soon`` when the loop next turns.
        source: Take only events of this source or below it: ``drone`` takes ``drone/front``.

    Raises:
        DeclarationError: The arguments contradict each other.
    """

    def __init__(
        self,
        event: type[T],
        *,
        keep: Literal["every", "latest"] = "every",
        bound: int = 1024,
        overflow: Overflow = "error",
        wake: Literal["now", "soon"] = "now",
        source: str | None = None,
    ) -> None:
        check_event_type("Input", event)
        if keep not in {"every", "latest"}:
            raise DeclarationError(f'Input: keep: expected "every" or "latest", found {keep!r}')
        if overflow not in {"error", "drop_oldest", "wait"}:
            raise DeclarationError(
                f'Input: overflow: expected "error", "drop_oldest" or "wait", found {overflow!r}'
            )
        if wake not in {"now", "soon"}:
            raise DeclarationError(f'Input: wake: expected "now" or "soon", found {wake!r}')
        if bound < 1:
            raise DeclarationError(f"Input: bound: expected at least 1, found {bound}")
        self.event = event
        self.keep = keep
        self.bound = 1 if keep == "latest" else bound
        self.overflow: Overflow = "drop_oldest" if keep == "latest" else overflow
        self.soon = wake == "soon"
        self.source = source

    @overload
    def __get__(self, node: None, owner: type) -> Self: ...
    @overload
    def __get__(self, node: object, owner: type) -> Stream[T]: ...
    def __get__(self, node: object | None, owner: type) -> Self | Stream[T]:
        """Return the declaration; an instance's stream stands in the instance itself."""
        return self._declaration(node, owner)

    def make(self, node: str) -> Stream[T]:
        """Return a new stream for the node of this name."""
        return Stream(f"{node}.{self.name}", self.bound, self.overflow, self.soon)


class Output(_Port, Generic[T]):
    """An output: ``self.estimate.send(event)``. On an instance this is a `Sender`.

    Args:
        when: Setting without which the node sends nothing here; "" for none.
    """

    def __init__(self, event: type[T], *, when: str = "") -> None:
        check_event_type("Output", event)
        self.event = event
        self.when = when

    @overload
    def __get__(self, node: None, owner: type) -> Self: ...
    @overload
    def __get__(self, node: object, owner: type) -> Sender[T]: ...
    def __get__(self, node: object | None, owner: type) -> Self | Sender[T]:
        """Return the declaration; an instance's sender stands in the instance itself."""
        return self._declaration(node, owner)


class Handles(msgspec.Struct, frozen=True):
    """Declaration of a method by `@on`."""

    events: tuple[type[Event], ...]
    source: str | None


class Ticks(msgspec.Struct, frozen=True):
    """Declaration of a method by `@every`."""

    hz: float | str


def on(*events: type[Event], source: str | None = None) -> Callable[[F], F]:
    """Make a method the handler of some types of event, with their subclasses.

    It runs inside `send`, in the order of the nodes in the file. It may return True: handled, and
    no node after this one gets the event. It must be quick, and cannot wait. With `source`, only
    events of this source or below it come.

    Raises:
        DeclarationError: No event type, or the method is a coroutine function or a generator.
    """
    for event in events:
        check_event_type("@on", event)
    if not events:
        raise DeclarationError("@on: expected an event type, found nothing")

    def declare(method: F) -> F:
        for kind, actual in (
            (inspect.iscoroutinefunction, "a coroutine function"),
            (inspect.isasyncgenfunction, "an asynchronous generator"),
            (inspect.isgeneratorfunction, "a generator"),
        ):
            if kind(method):
                raise DeclarationError(
                    f"@on: {method.__qualname__}: expected a plain function, found {actual}; "
                    "to wait for things, read an Input in run()"
                )
        method.__handles__ = Handles(events, source)  # type: ignore[attr-defined]
        return method

    return declare


def every(*, hz: float | str) -> Callable[[F], F]:
    """Call a method at a steady rate: on time in real time, exactly so in lockstep.

    The method takes a `Tick`. A coroutine function is allowed; ticks that come while its last
    call is still running are skipped and counted as missed.

    Args:
        hz: Calls per second of the run's clock, or the name of the setting that holds it.

    Raises:
        DeclarationError: The rate is not positive.
    """
    if not isinstance(hz, str) and not 0 < hz <= MAX_HZ:
        raise DeclarationError(f"@every: hz: expected a rate above 0, up to {MAX_HZ}, found {hz}")

    def declare(method: F) -> F:
        method.__ticks__ = Ticks(hz)  # type: ignore[attr-defined]
        return method

    return declare


MAX_HZ = 100_000  # above this a tick takes longer than its period on any machine


def check_event_type(where: str, event: Any) -> None:
    """Raise `DeclarationError` unless `event` is a type of event."""
    if not (isinstance(event, type) and issubclass(event, Event)):
        raise DeclarationError(f"{where}: expected a subclass of Event, found {event!r}")
