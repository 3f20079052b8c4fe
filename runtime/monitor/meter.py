"""Measuring what nodes have of the loop, and how old events are, while somebody looks."""

from __future__ import annotations

import time
from concurrent.futures import Future
from typing import Any

from events import Event
from runtime.clock import Clock
from runtime.probes import Call
from runtime.sender import Sender, Tap


class Steps:
    """What one node had of the loop since the last look: nanoseconds, less those of others."""

    __slots__ = ("busy", "count", "longest")

    def __init__(self) -> None:
        self.busy = 0
        self.count = 0
        self.longest = 0


class Flow:
    """What one output sent since the last look: nanoseconds from stamp to delivery."""

    __slots__ = ("count", "last", "longest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0
        self.longest = 0
        self.last = 0
        """When the last event was sent, on the run's clock (ns)."""


class Meter:
    """A probe that adds up.

    Args:
        clock: The run's clock.

    Attributes:
        nodes: What each node had of the loop, by name.
        outputs: What each output sent, by ``node.port``.
    """

    def __init__(self, clock: Clock) -> None:
        self.nodes: dict[str, Steps] = {}
        self.outputs: dict[str, Flow] = {}
        self._clock = clock
        self._inner = [0]
        """Nanoseconds that the steps within the one that runs have taken."""
        self.tap: Tap = self._tap

    def around(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function that calls `call` and adds up how long it takes."""
        inner, time_ns = self._inner, time.perf_counter_ns
        steps = self.nodes.setdefault(node, Steps())

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
                steps.busy += own
                steps.count += 1
                if own > steps.longest:
                    steps.longest = own

        return metering

    def asked(self, process: str, method: str, answer: Future[Any]) -> None:
        """Know of calls of workers already: they can be counted at any time."""

    def reset(self) -> None:
        """Begin anew to add up."""
        for steps in self.nodes.values():
            steps.busy = steps.count = steps.longest = 0
        for flow in self.outputs.values():
            flow.count = flow.total = flow.longest = 0

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        name = "run.announced" if sender is None else sender.name
        flow = self.outputs.get(name)
        if flow is None:
            flow = self.outputs[name] = Flow()
        now = self._clock.now()
        latency = now - event.stamp
        flow.count += 1
        flow.total += latency
        flow.last = now
        if latency > flow.longest:
            flow.longest = latency
