"""One memory object stream of anyio a node, on asyncio with uvloop.

Streams are unbounded and filled with `send_nowait`, which does not pass the checkpoint that
`await send()` would: anyio's quickest way.
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


async def _exchange(anyio: Any, case: Case) -> Samples:
    reply, replies = anyio.create_memory_object_stream(math.inf)
    streams = [anyio.create_memory_object_stream(math.inf) for _ in range(case.nodes - 1)]
    outputs = [output for output, _ in streams]
    payload = payloads(case)
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    async with anyio.create_task_group() as group:
        for node, (_, stream) in enumerate(streams, start=2):
            group.start_soon(_listen, node, stream, reply)
        for number in range(len(taken)):
            begin = now()
            ping = Ping(
                stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload()
            )
            for output in outputs:
                output.send_nowait(ping)
            await replies.receive()
            taken[number] = now() - begin
        group.cancel_scope.cancel()
    for end in (reply, replies, *(end for ends in streams for end in ends)):
        end.close()
    return taken[case.warm_up :]


def measure(case: Case) -> Samples:
    """Measure round trips through memory object streams."""
    anyio: Any = importlib.import_module("anyio")
    options = {"use_uvloop": True}
    samples: Samples = anyio.run(_exchange, anyio, case, backend="asyncio", backend_options=options)
    return samples


SYSTEMS = (
    System(
        name="anyio streams (uvloop)",
        modes=("stream",),
        slowness=6,
        missing=needs(anyio="anyio", uvloop="uvloop"),
        version=versions("anyio", "uvloop"),
        measure=measure,
    ),
)
