"""One `asyncio.Queue` a node and one task around each: what asyncio itself offers.

Queues are unbounded and filled with `put_nowait`, so node 1 wakes all receivers before any runs.
Measured on the loop of asyncio and on uvloop.
"""

from __future__ import annotations

import asyncio
import platform
import time
from collections.abc import Callable

import numpy as np
import uvloop

from bench.messages import Ping, Pong
from bench.system import Case, Samples, System
from bench.systems.parts import payloads, versions


async def _listen(number: int, pings: asyncio.Queue[Ping], pongs: asyncio.Queue[Pong]) -> None:
    while True:
        ping = await pings.get()
        if ping.receiver == number:
            pongs.put_nowait(Pong(stamp=ping.stamp, source="n", number=ping.number))


async def _exchange(case: Case) -> Samples:
    pongs: asyncio.Queue[Pong] = asyncio.Queue()
    queues: list[asyncio.Queue[Ping]] = [asyncio.Queue() for _ in range(case.nodes - 1)]
    payload = payloads(case)
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(_listen(number, queue, pongs))
            for number, queue in enumerate(queues, start=2)
        ]
        await asyncio.sleep(0)
        for number in range(len(taken)):
            begin = now()
            ping = Ping(
                stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload()
            )
            for queue in queues:
                queue.put_nowait(ping)
            await pongs.get()
            taken[number] = now() - begin
        for task in tasks:
            task.cancel()
    return taken[case.warm_up :]


def _measure_on(new_loop: Callable[[], asyncio.AbstractEventLoop]) -> Callable[[Case], Samples]:
    def measure(case: Case) -> Samples:
        with asyncio.Runner(loop_factory=new_loop) as runner:
            return runner.run(_exchange(case))

    return measure


SYSTEMS = (
    System(
        name="asyncio.Queue (asyncio)",
        modes=("stream",),
        slowness=10,
        version=lambda: f"Python {platform.python_version()}",
        measure=_measure_on(asyncio.new_event_loop),
    ),
    System(
        name="asyncio.Queue (uvloop)",
        modes=("stream",),
        slowness=5,
        version=versions("uvloop"),
        measure=_measure_on(uvloop.new_event_loop),
    ),
)
