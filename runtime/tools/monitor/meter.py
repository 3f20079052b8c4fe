"""Measuring what nodes have of the loop, and how old events are, while somebody looks."""

from __future__ import annotations

import time
from typing import Any

from events import Event, Image
from runtime.clock import Clock
from runtime.instruments import Call, Instrument
from runtime.sender import Sender
from runtime.tools.monitor.recent import Amount


class Sum:
    """Durations since the last look: nanoseconds."""

    __slots__ = ("count", "last", "longest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0
        self.longest = 0
        self.last = 0
        """When the last one ended, on the run's clock (ns); of outputs only."""

    def take(self) -> Amount:
        """Return what was added up, and begin anew."""
        amount = Amount(self.count, self.total, self.longest)
        self.count = self.total = self.longest = 0
        return amount


class Meter(Instrument):
    """An instrument that adds up.

    Args:
        clock: The run's clock.

    Attributes:
        nodes: What each node had of the loop, by name: its steps, less what they called in others.
        outputs: What lay between stamp and delivery of each output's events, by ``node.port``.
        images: The newest image of each camera, by ``node.port: source``.
    """

    def __init__(self, clock: Clock) -> None:
        self.nodes: dict[str, Sum] = {}
        self.outputs: dict[str, Sum] = {}
        self.images: dict[str, Image] = {}
        self._clock = clock
        self._inner = [0]
        """Nanoseconds that the steps within the one that runs have taken."""
        self.event_sent = self._tap

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function that calls `call` and adds up how long it takes."""
        inner, time_ns = self._inner, time.perf_counter_ns
        steps = self.nodes.setdefault(node, Sum())

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
            flow = self.outputs[name] = Sum()
        now = self._clock.now()
        latency = now - event.stamp
        flow.count += 1
        flow.total += latency
        flow.last = now
        if latency > flow.longest:
            flow.longest = latency
        if isinstance(event, Image):
            self.images[f"{name}: {event.source}"] = event
