"""Functions that are called within the send: a dict of handlers, and pyee's `EventEmitter`.

The dict is the floor: nothing in Python delivers events for less.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.system import Case, Ping, Pong, Samples, System
from bench.systems.parts import needs, payloads, versions


def _exchange(case: Case, send: Callable[[Any], Any], hear: Callable[[type, Any], Any]) -> Samples:
    """Return the samples; `hear` makes a function one that `send` calls for events of a type."""
    arrived = 0
    now = time.perf_counter_ns

    class Listener:
        def __init__(self, number: int) -> None:
            self.number = number

        def ping(self, event: Ping) -> bool | None:
            if event.receiver == self.number:
                send(Pong(stamp=event.stamp, source="n", number=event.number))
                return True
            return None

    def pong(_: Pong) -> None:
        nonlocal arrived
        arrived = now()

    for number in range(2, case.nodes + 1):
        hear(Ping, Listener(number).ping)
    hear(Pong, pong)
    payload = payloads(case)
    taken = np.empty(case.warm_up + case.samples, np.int64)
    for number in range(len(taken)):
        begin = now()
        send(Ping(stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload()))
        taken[number] = arrived - begin
    return taken[case.warm_up :]


def measure(case: Case) -> Samples:
    """Measure round trips through a dict from type to a list of functions."""
    handlers: dict[type, list[Callable[[Any], bool | None]]] = {Ping: [], Pong: []}

    def send(event: Any) -> None:
        for handler in handlers[type(event)]:
            if handler(event):
                break

    return _exchange(case, send, lambda kind, handler: handlers[kind].append(handler))


def measure_pyee(case: Case) -> Samples:
    """Measure round trips through one emitter, whose events are named by their types."""
    emitter: Any = importlib.import_module("pyee.base").EventEmitter()
    emit = emitter.emit
    return _exchange(
        case,
        lambda event: emit(type(event).__name__, event),
        lambda kind, handler: emitter.on(kind.__name__, handler),
    )


SYSTEMS = (
    System(name="plain calls", modes=("handler",), slowness=0.5, measure=measure),
    System(
        name="pyee",
        modes=("handler",),
        slowness=2,
        missing=needs(pyee="pyee"),
        version=versions("pyee"),
        measure=measure_pyee,
    ),
)
