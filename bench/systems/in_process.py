"""Systems with all nodes in a process, requiring only Python or a package for Python.

Functions called within the send: a dict of handlers, the floor, since nothing in Python delivers
events for less; and pyee's `EventEmitter`.

One queue a node and one task around each: `asyncio.Queue` on asyncio's own loop and on uvloop,
anyio's memory object streams (on uvloop) and trio's memory channels. All are unbounded and filled
at once: ``put_nowait`` and ``send_nowait`` pass no checkpoint, as ``await send()`` would, which is
the quickest way of each. So node 1 wakes all receivers before any runs; trio runs what is ready in
an order of chance, and node 1, woken by the reply, after all of them.
"""

from __future__ import annotations

import asyncio
import importlib
import math
import platform
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import numpy as np
import uvloop

from bench.system import Case, Ping, Pong, Samples, System, packaged, payloads, versions

Put = Callable[[Any], None]


def _call(case: Case, send: Callable[[Any], Any], hear: Callable[[type, Any], Any]) -> Samples:
    """Return the samples; `hear` registers a function with `send` for events of a type."""
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


def measure_calls(case: Case) -> Samples:
    """Measure round trips through a dict from type to a list of functions."""
    handlers: dict[type, list[Callable[[Any], bool | None]]] = {Ping: [], Pong: []}

    def send(event: Any) -> None:
        for handler in handlers[type(event)]:
            if handler(event):
                break

    return _call(case, send, lambda kind, handler: handlers[kind].append(handler))


def measure_pyee(case: Case) -> Samples:
    """Measure round trips through a single emitter, with types as names of events."""
    emitter: Any = importlib.import_module("pyee.base").EventEmitter()
    emit = emitter.emit
    return _call(
        case,
        lambda event: emit(type(event).__name__, event),
        lambda kind, handler: emitter.on(kind.__name__, handler),
    )


async def _exchange(case: Case, puts: Sequence[Put], receive: Callable[[], Awaitable[Any]]) -> Any:
    payload = payloads(case)
    now = time.perf_counter_ns
    taken = np.empty(case.warm_up + case.samples, np.int64)
    for number in range(len(taken)):
        begin = now()
        ping = Ping(stamp=begin, source="1", receiver=case.nodes, number=number, payload=payload())
        for put in puts:
            put(ping)
        await receive()
        taken[number] = now() - begin
    return taken[case.warm_up :]


def _answer(number: int, ping: Ping, put: Put) -> None:
    if ping.receiver == number:
        put(Pong(stamp=ping.stamp, source="n", number=ping.number))


async def _listen_queue(number: int, pings: asyncio.Queue[Ping], put: Put) -> None:
    while True:
        _answer(number, await pings.get(), put)


async def _listen_stream(number: int, pings: Any, put: Put) -> None:
    async for ping in pings:
        _answer(number, ping, put)


async def _by_queues(case: Case) -> Samples:
    pongs: asyncio.Queue[Pong] = asyncio.Queue()
    queues: list[asyncio.Queue[Ping]] = [asyncio.Queue() for _ in range(case.nodes - 1)]
    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(_listen_queue(number, queue, pongs.put_nowait))
            for number, queue in enumerate(queues, start=2)
        ]
        await asyncio.sleep(0)
        samples: Samples = await _exchange(case, [q.put_nowait for q in queues], pongs.get)
        for task in tasks:
            task.cancel()
    return samples


async def _by_streams(
    case: Case, new: Callable[[float], tuple[Any, Any]], new_group: Callable[[], Any]
) -> Samples:
    """Exchange over pairs of stream ends from `new`, in a task group from `new_group`."""
    reply, replies = new(math.inf)
    streams = [new(math.inf) for _ in range(case.nodes - 1)]
    async with new_group() as group:
        for number, (_, stream) in enumerate(streams, start=2):
            group.start_soon(_listen_stream, number, stream, reply.send_nowait)
        puts = [output.send_nowait for output, _ in streams]
        samples: Samples = await _exchange(case, puts, replies.receive)
        group.cancel_scope.cancel()
    for end in (reply, replies, *(end for ends in streams for end in ends)):
        end.close()
    return samples


def measure_asyncio(case: Case) -> Samples:
    """Measure round trips through queues on asyncio's own loop."""
    return asyncio.run(_by_queues(case))


def measure_uvloop(case: Case) -> Samples:
    """Measure round trips through queues on uvloop."""
    return uvloop.run(_by_queues(case))


def measure_anyio(case: Case) -> Samples:
    """Measure round trips through memory object streams."""
    anyio: Any = importlib.import_module("anyio")
    ends, group = anyio.create_memory_object_stream, anyio.create_task_group
    samples: Samples = anyio.run(
        _by_streams, case, ends, group, backend="asyncio", backend_options={"use_uvloop": True}
    )
    return samples


def measure_trio(case: Case) -> Samples:
    """Measure round trips through memory channels."""
    trio: Any = importlib.import_module("trio")
    samples: Samples = trio.run(_by_streams, case, trio.open_memory_channel, trio.open_nursery)
    return samples


def _python() -> str:
    return f"Python {platform.python_version()}"


_ANYIO = packaged(anyio="anyio", uvloop="uvloop")

SYSTEMS = (
    System("plain calls", ("handler",), measure_calls, 0.5),
    System("pyee", ("handler",), measure_pyee, 2, **packaged(pyee="pyee")),
    System("asyncio.Queue (asyncio)", ("stream",), measure_asyncio, 10, version=_python),
    System("asyncio.Queue (uvloop)", ("stream",), measure_uvloop, 5, version=versions("uvloop")),
    System("anyio streams (uvloop)", ("stream",), measure_anyio, 6, **_ANYIO),
    System("trio channels", ("stream",), measure_trio, 12, **packaged(trio="trio")),
)
