"""The floor: a dict of handlers, called plainly. Nothing in Python delivers events for less."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.messages import Ping, Pong
from bench.system import Case, Samples, System, large_array


def measure(case: Case) -> Samples:
    """Measure round trips through a dict from type to a list of functions."""
    handlers: dict[type, list[Callable[[Any], bool | None]]] = {Ping: [], Pong: []}

    def send(event: Any) -> None:
        for handler in handlers[type(event)]:
            if handler(event):
                break

    class Listener:
        def __init__(self, number: int) -> None:
            self.number = number

        def ping(self, event: Ping) -> bool | None:
            if event.receiver == self.number:
                send(Pong(stamp=event.stamp, source="n", number=event.number))
                return True
            return None

    arrived = 0

    def pong(_: Pong) -> None:
        nonlocal arrived
        arrived = now()

    handlers[Ping] = [Listener(n).ping for n in range(2, case.nodes + 1)]
    handlers[Pong] = [pong]
    array = None if case.case == "small" else large_array()
    copied = case.case == "large"
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    for number in range(len(taken)):
        begin = now()
        payload = array.copy() if copied and array is not None else array
        send(Ping(stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload))
        taken[number] = arrived - begin
    return taken[case.warm_up :]


SYSTEMS = (System(name="plain calls", modes=("handler",), slowness=0.5, measure=measure),)
