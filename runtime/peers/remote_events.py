"""Outputs here with listeners in other processes, and outputs there with listeners here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from events import Event
from runtime.channels.sender import Listener, Sender
from runtime.channels.tasks import Fault
from runtime.config.model import NodeSpec
from runtime.errors import WireError
from runtime.peers.messages import Subscription
from runtime.wire import event_type, kind_of

Leave = Callable[[int, str, Event, bool], None]
"""Sends an event: process number, output, event, and whether a newer event may replace this."""


class RemoteEvents:
    """Events between this process and the others."""

    def __init__(
        self, specs: Iterable[NodeSpec], owners: dict[str, int], me: int, leave: Leave
    ) -> None:
        self._leave = leave
        self._wanted: dict[int, tuple[Subscription, ...]] = {}
        self._arrivals: dict[str, tuple[int, Sender[Any]]] = {}
        for spec in specs:
            if owners[spec.name] != me:
                for port, output in spec.node.declared.outputs.items():
                    name = f"{spec.name}.{port}"
                    self._arrivals[name] = (owners[spec.name], Sender(name, output.event))

    def wants(self, process: int, wanted: tuple[Subscription, ...]) -> None:
        """Record the subscriptions of a process, empty if gone; `WireError` for unknown events."""
        for each in wanted:
            for kind in each.kinds:
                event_type(kind)
        self._wanted[process] = wanted

    def listeners(self, output: str) -> list[Listener]:
        """Return the listeners in other processes; before those here, to reach them in any case."""
        return [
            RemoteListener(process, output, wanted, self._leave)
            for process, wanted in sorted(self._wanted.items())
        ]

    def connect(self, listeners: Iterable[Listener], fault: Fault) -> None:
        """Connect the listeners here to outputs elsewhere."""
        listeners = list(listeners)
        for _, sender in self._arrivals.values():
            sender.connect(listeners, fault=fault)

    def arrive(self, process: int, output: str, event: Event) -> None:
        """Deliver an event of another process; `WireError` if it has no such output."""
        owner, sender = self._arrivals.get(output, (None, None))
        if sender is None or owner != process:
            raise WireError(f"expected an output of process {process}, found {output!r}")
        if not isinstance(event, sender.event):
            raise WireError(
                f"{output}: expected {sender.event.__name__}, found {type(event).__name__}"
            )
        sender.send(event)


class RemoteListener(Listener):
    """All inputs and handlers of another process, as a single listener of an output."""

    __slots__ = ("_leave", "_listeners", "_may_skip", "_output", "_process", "name")

    def __init__(
        self, process: int, output: str, wanted: tuple[Subscription, ...], leave: Leave
    ) -> None:
        super().__init__("", self.offer, ())
        self.name = output  # whose fault it is if it cannot leave
        self._process = process
        self._output = output
        self._leave = leave
        self._listeners = [
            (Listener("", _nothing, tuple(map(event_type, each.kinds)), each.source), each.latest)
            for each in wanted
        ]
        self._may_skip: dict[tuple[type[Event], str], bool] = {}

    def may_receive(self, event: type[Event]) -> bool:
        """Return whether anything there can receive from an output of this type."""
        return any(listener.may_receive(event) for listener, _ in self._listeners)

    def receives_all(self, event: type[Event]) -> bool:
        """Return whether any listener there receives all events of an output of this type."""
        return any(listener.receives_all(event) for listener, _ in self._listeners)

    def receives(self, event: type[Event], source: str) -> bool:
        """Return whether anything there receives events of this very type from this source."""
        return any(listener.receives(event, source) for listener, _ in self._listeners)

    def offer(self, event: Event) -> None:
        """Send an event there."""
        key = (type(event), event.source)
        skip = self._may_skip.get(key)
        if skip is None:
            skip = all(latest for listener, latest in self._listeners if listener.receives(*key))
            self._may_skip[key] = skip
        self._leave(self._process, self._output, event, skip)


def subscriptions(listeners: Iterable[Listener]) -> tuple[Subscription, ...]:
    """Return the subscriptions of these listeners, for other processes."""
    found = {
        Subscription(
            kinds=tuple(kind_of(event) for event in listener.events),
            source=listener.source,
            latest=listener.stream is not None
            and listener.stream.bound == 1
            and listener.stream.overflow == "drop_oldest",
        ): None
        for listener in listeners
    }
    return tuple(found)


def _nothing(_: Any) -> None:
    pass
