"""ezmsg: a unit per node, all in a single process, or nodes 2 to N in a process each.

Units are run by `ezmsg.core.run` with a graph server of our own; ezmsg brings its own loop of
asyncio. Node 1 sends the next ping from the method that gets the pong. In one process messages go
by reference, as inputs that are not leaky do; between processes ezmsg pickles them into shared
memory, large arrays out of band, in buffers that are large enough from the start.
"""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
import os
import time
from collections.abc import AsyncGenerator, Callable
from typing import Any, Protocol, TypeVar

import numpy as np

from bench.system import Case, Ping, Pong, Samples, System, in_processes, packaged, payloads
from bench.systems.children import ALL, PeerError, answer

_BUFFER = 1 << 23
_Method = TypeVar("_Method", bound=Callable[..., Any])


class Exchange:
    """State of node 1 between messages."""

    def __init__(self, case: Case) -> None:
        self.taken = np.zeros(case.warm_up + case.samples, np.int64)
        self.absent = set(range(2, case.nodes + 1))
        self.done = False
        self._payload = payloads(case)
        self._receiver = case.nodes
        self._number = -1
        self._begin = 0

    def ping(self) -> Ping:
        """Return the next ping, or a call of the roll as long as nodes are absent."""
        self._begin = time.perf_counter_ns()
        return Ping(
            stamp=self._begin,
            source="1",
            receiver=ALL if self.absent else self._receiver,
            number=self._number,
            payload=self._payload(),
        )

    def pong(self, pong: Pong) -> bool:
        """Record a pong, and return whether the next ping is due."""
        arrived = time.perf_counter_ns()
        if self.absent:
            self.absent.discard(-pong.number)
            self._number += not self.absent
            return not self.absent
        if pong.number != self._number:
            return False
        self.taken[self._number] = arrived - self._begin
        self._number += 1
        self.done = self._number == len(self.taken)
        return not self.done


class _OfStream(Protocol):
    """Type of ezmsg's ``publisher`` and ``subscriber`` decorators of methods."""

    def __call__(self, stream: Any, /) -> Callable[[_Method], _Method]: ...


def _units(ez: Any) -> tuple[Any, Any]:
    publisher: _OfStream = ez.publisher
    subscriber: _OfStream = ez.subscriber
    task: Callable[[_Method], _Method] = ez.task

    class Sender(ez.Unit):  # type: ignore[misc]
        PING = ez.OutputStream(Ping, buf_size=_BUFFER)
        PONG = ez.InputStream(Pong)
        exchange: Exchange

        @publisher(PING)
        async def call_roll(self) -> AsyncGenerator[tuple[Any, Ping]]:
            while self.exchange.absent:
                yield self.PING, self.exchange.ping()
                await asyncio.sleep(0.1)

        @subscriber(PONG)
        @publisher(PING)
        async def on_pong(self, pong: Pong) -> AsyncGenerator[tuple[Any, Ping]]:
            if self.exchange.pong(pong):
                yield self.PING, self.exchange.ping()
            elif self.exchange.done:
                raise ez.NormalTermination

    class Listener(ez.Unit):  # type: ignore[misc]
        PING = ez.InputStream(Ping)
        PONG = ez.OutputStream(Pong)
        number: int
        measuring: int = 0

        @subscriber(PING)
        @publisher(PONG)
        async def on_ping(self, ping: Ping) -> AsyncGenerator[tuple[Any, Pong]]:
            number = answer(self.number, ping.receiver, ping.number)
            if number is not None:
                yield self.PONG, Pong(stamp=ping.stamp, source="n", number=number)

        @task
        async def end_with_parent(self) -> None:
            while self.measuring:
                await asyncio.sleep(1.0)
                if os.getppid() != self.measuring:
                    os._exit(1)

    return Sender, Listener


def measure(case: Case, *, processes: bool = False) -> Samples:
    """Measure round trips between units."""
    os.environ["EZMSG_LOGLEVEL"] = "ERROR"
    # The units' classes are made here, and reach the other processes with a fork only.
    multiprocessing.set_start_method("fork", force=True)
    ez: Any = importlib.import_module("ezmsg.core")
    server: Any = importlib.import_module("ezmsg.core.graphserver").GraphServer()
    make_sender, make_listener = _units(ez)
    sender = make_sender()
    sender.exchange = Exchange(case)
    components = {"NODE1": sender}
    connections = []
    for number in range(2, case.nodes + 1):
        components[f"NODE{number}"] = listener = make_listener()
        listener.number = number
        listener.measuring = os.getpid() if processes else 0
        connections += [(sender.PING, listener.PING), (listener.PONG, sender.PONG)]
    server.start(("127.0.0.1", 0))
    try:
        ez.run(
            components=components,
            connections=connections,
            process_components=[*components.values()][1:] if processes else None,
            graph_address=server.address,
            force_single_process=not processes,
        )
    finally:
        server.stop()
    if not sender.exchange.done:
        raise PeerError("ezmsg: ended before the last ping")
    taken: Samples = sender.exchange.taken[case.warm_up :]
    return taken


def measure_processes(case: Case) -> Samples:
    """Measure round trips between processes."""
    return measure(case, processes=True)


_PACKAGE = packaged(ezmsg="ezmsg")

SYSTEMS = (
    System("ezmsg (one process)", ("handler",), measure, 30, **_PACKAGE),
    in_processes("ezmsg (processes)", ("handler",), measure_processes, 250, **_PACKAGE),
)
