"""Our own runtime, measured as used: nodes, ports and a supervisor, on uvloop."""

from __future__ import annotations

import asyncio
import functools
import importlib.metadata
import time
from typing import Any

import numpy as np
import numpy.typing as npt
import uvloop

from bench.system import Case, Ping, Pong, Samples, System, payloads
from runtime import Input, Node, NodeConfig, Output, on
from runtime.channels.wire import Digest
from runtime.config.model import Config, RunConfig
from runtime.run import event_loop
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.time.clock import RealClock


class OneConfig(NodeConfig):
    """Settings of node 1: the case to measure."""

    case: Case


class _One(Node[OneConfig]):
    pings = Output(Ping)

    def __init__(self) -> None:
        case = self.config.case
        self.payload = payloads(case)
        self.taken: npt.NDArray[np.int64] = np.empty(case.warm_up + case.samples, np.int64)
        self.target = "one" if case.mode != "routed" else f"one/{case.nodes}"


class HandlerOne(_One):
    """Node 1 with a handler for the replies."""

    def __init__(self) -> None:
        super().__init__()
        self.arrived = 0

    @on(Pong)
    def pong(self, _: Pong) -> None:
        """Note the time."""
        self.arrived = time.perf_counter_ns()

    async def run(self) -> None:
        """Measure; nothing here waits, so a sample is a single call of `send`."""
        now, send, taken, payload = time.perf_counter_ns, self.pings.send, self.taken, self.payload
        target, to = self.target, self.config.case.nodes
        for number in range(len(taken)):
            begin = now()
            send(Ping(stamp=begin, source=target, receiver=to, number=number, payload=payload()))
            taken[number] = self.arrived - begin
        self.stop("measured")


class StreamOne(_One):
    """Node 1 awaiting the replies."""

    pongs = Input(Pong)

    async def run(self) -> None:
        """Measure."""
        now, send, taken, payload = time.perf_counter_ns, self.pings.send, self.taken, self.payload
        target, to, pongs = self.target, self.config.case.nodes, self.pongs
        for number in range(len(taken)):
            begin = now()
            send(Ping(stamp=begin, source=target, receiver=to, number=number, payload=payload()))
            await anext(pongs)
            taken[number] = now() - begin
        self.stop("measured")


class OtherConfig(NodeConfig):
    """Settings of the listening nodes."""

    number: int


class HandlerOther(Node[OtherConfig]):
    """Nodes 2 to N with handlers."""

    pongs = Output(Pong)

    def __init__(self) -> None:
        self.number = self.config.number

    @on(Ping)
    def ping(self, event: Ping) -> bool | None:
        """Reply to a ping for this node."""
        if event.receiver == self.number:
            self.pongs.send(Pong(stamp=event.stamp, source=self.name, number=event.number))
            return True
        return None


class StreamOther(Node[OtherConfig]):
    """Nodes 2 to N with coroutines."""

    pings = Input(Ping)
    pongs = Output(Pong)

    async def run(self) -> None:
        """Reply to each ping for this node."""
        number = self.config.number
        async for event in self.pings:
            if event.receiver == number:
                self.pongs.send(Pong(stamp=event.stamp, source=self.name, number=event.number))


def measure(case: Case, digest: bool = False) -> Samples:
    """Measure a case with real nodes; with `digest`, as a lockstep run would fingerprint them."""
    one, other = (StreamOne, StreamOther) if case.mode == "stream" else (HandlerOne, HandlerOther)
    others = [
        spec(
            other,
            f"n{n}",
            {"number": n},
            inputs={"ping": f"one/{n}"} if case.mode == "routed" else {},
        )
        for n in range(2, case.nodes + 1)
    ]
    config = Config(run=RunConfig(clock="real"), nodes=(spec(one, "one", {"case": case}), *others))

    async def main() -> Any:
        loop = asyncio.get_running_loop()
        event_loop.install(loop)
        clock = RealClock(loop)
        supervisor = Supervisor(config, clock, [Digest()] if digest else [])
        await supervisor.main()
        clock.close()
        if supervisor.state.error is not None:
            raise supervisor.state.error
        return supervisor.state.all_nodes[0]

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        samples: Samples = runner.run(main()).taken[case.warm_up :]
    return samples


def _version() -> str:
    return f"visnav-runtime {importlib.metadata.version('visnav-runtime')}"


SYSTEMS = (
    System("visnav", ("handler", "stream", "routed"), measure, 0.6, version=_version),
    System(
        "visnav, fingerprinted",
        ("handler", "stream"),
        functools.partial(measure, digest=True),
        slowness=3.0,
        cases=("small",),
        version=_version,
    ),
)
