"""Measures how much of the loop nodes take, and how old events are, while somebody watches."""

from __future__ import annotations

import time
from typing import Any

from events import Event, Image
from runtime.clock import Clock
from runtime.instruments import Call, Instrument
from runtime.sender import Sender
from runtime.tools.monitor.recent import Amount


class DurationSum:
    """Durations since the last snapshot, nanoseconds."""

    __slots__ = ("count", "last", "longest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0
        self.longest = 0
        self.last = 0
        """When the last one ended, on the run's clock (ns); of outputs only."""

    def take(self) -> Amount:
        """Return the sum, and start again from zero."""
        amount = Amount(self.count, self.total, self.longest)
        self.count = self.total = self.longest = 0
        return amount


class Meter(Instrument):
    """An instrument that adds up durations, and keeps the newest images.

    Args:
        clock: The run's clock.

    Attributes:
        nodes: Time each node took of the loop, by name, without the calls of other nodes in it.
        outputs: Times from stamp to delivery of each output's events, by ``node.port``.
        images: The newest image of each camera, by ``node.port: source``.
    """

    def __init__(self, clock: Clock) -> None:
        self.nodes: dict[str, DurationSum] = {}
        self.outputs: dict[str, DurationSum] = {}
        self.images: dict[str, Image] = {}
        self._clock = clock
        self._inner = [0]
        """Nanoseconds that the steps within the one that runs have taken."""
        self.event_sent = self._tap

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function that calls `call` and adds up how long it takes."""
        inner, time_ns = self._inner, time.perf_counter_ns
        steps = self.nodes.setdefault(node, DurationSum())

        def metering(argument: Any) -> Any:
            outer = inner[0]
            inner[0] = 0
            begin = time_ns()
            try:
                return call(argument)
            finally:
                took = time_ns() - begin
                own = took - inner[0]
                inner[0] = outer + took
                steps.total += own
                steps.count += 1
                if own > steps.longest:
                    steps.longest = own

        return metering

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        name = "run.announced" if sender is None else sender.name
        flow = self.outputs.get(name)
        if flow is None:
            flow = self.outputs[name] = DurationSum()
        now = self._clock.now()
        latency = now - event.stamp
        flow.count += 1
        flow.total += latency
        flow.last = now
        if latency > flow.longest:
            flow.longest = latency
        if isinstance(event, Image):
            self.images[f"{name}: {event.source}"] = event
