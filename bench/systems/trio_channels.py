"""One memory channel of trio a node, on trio's own loop.

Channels are unbounded and filled with `send_nowait`, which does not pass the checkpoint that
`await send()` would: trio's quickest way. Trio runs what is ready in an order of chance; node 1,
woken by the reply, runs after all of them.
"""

from __future__ import annotations

import importlib
import math
import time
from typing import Any

import numpy as np

from bench.messages import Ping, Pong
from bench.system import Case, Samples, System
from bench.systems.parts import needs, payloads, versions


async def _listen(number: int, pings: Any, pongs: Any) -> None:
    async for ping in pings:
        if ping.receiver == number:
            pongs.send_nowait(Pong(stamp=ping.stamp, source="n", number=ping.number))


async def _exchange(trio: Any, case: Case) -> Samples:
    reply, replies = trio.open_memory_channel(math.inf)
    channels = [trio.open_memory_channel(math.inf) for _ in range(case.nodes - 1)]
    outputs = [output for output, _ in channels]
    payload = payloads(case)
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    async with trio.open_nursery() as nursery:
        for node, (_, channel) in enumerate(channels, start=2):
            nursery.start_soon(_listen, node, channel, reply)
        await trio.lowlevel.checkpoint()
        for number in range(len(taken)):
            begin = now()
            ping = Ping(
                stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload()
            )
            for output in outputs:
                output.send_nowait(ping)
            await replies.receive()
            taken[number] = now() - begin
        nursery.cancel_scope.cancel()
    return taken[case.warm_up :]


def measure(case: Case) -> Samples:
    """Measure round trips through memory channels."""
    trio: Any = importlib.import_module("trio")
    samples: Samples = trio.run(_exchange, trio, case)
    return samples


SYSTEMS = (
    System(
        name="trio channels",
        modes=("stream",),
        slowness=12,
        missing=needs(trio="trio"),
        version=versions("trio"),
        measure=measure,
    ),
)
