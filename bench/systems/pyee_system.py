"""pyee's `EventEmitter`: listeners are called synchronously within `emit`, in order."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np

from bench.messages import Ping, Pong
from bench.system import Case, Samples, System
from bench.systems.parts import needs, payloads, versions


def measure(case: Case) -> Samples:
    """Measure round trips through one emitter with an event for pings and one for pongs."""
    emitter: Any = importlib.import_module("pyee.base").EventEmitter()
    arrived = 0

    class Listener:
        def __init__(self, number: int) -> None:
            self.number = number

        def ping(self, event: Ping) -> None:
            if event.receiver == self.number:
                emitter.emit("pong", Pong(stamp=event.stamp, source="n", number=event.number))

    def pong(_: Pong) -> None:
        nonlocal arrived
        arrived = now()

    listeners = [Listener(number) for number in range(2, case.nodes + 1)]
    for listener in listeners:
        emitter.on("ping", listener.ping)
    emitter.on("pong", pong)
    payload = payloads(case)
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    for number in range(len(taken)):
        begin = now()
        emitter.emit(
            "ping",
            Ping(stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload()),
        )
        taken[number] = arrived - begin
    return taken[case.warm_up :]


SYSTEMS = (
    System(
        name="pyee",
        modes=("handler",),
        slowness=2,
        missing=needs(pyee="pyee"),
        version=versions("pyee"),
        measure=measure,
    ),
)
