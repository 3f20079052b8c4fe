"""asyncio-for-robotics over Zenoh, on uvloop: in a single session, and between processes (TCP).

Nodes wait in `Sub.listen_reliable`, which skips nothing, and send with Zenoh itself, as the library
means it. Messages, sessions and their settings are those of `bench.systems.zenoh_system`; Zenoh
hands them to a thread, and that to the loop, in one process too; there, as between processes, the
last node's reply may be there before all others have the ping.
"""

from __future__ import annotations

import asyncio
import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import uvloop

from bench import system
from bench.systems.children import ALL, Crew, Job, children, number_of, reply_to
from bench.systems.zenoh_system import header, pinger


async def _listen(node: int, session: Any, *, large: bool) -> None:
    afor: Any = importlib.import_module("asyncio_for_robotics.zenoh")
    pongs = system.zenoh_publisher(session, "pong")
    pings = afor.Sub("ping", session)
    async for sample in pings.listen_reliable(queue_size=0):
        pong = reply_to(node, header(sample, large=large))
        if pong is not None:
            pongs.put(pong)


class _Sender:
    def __init__(self, session: Any, case: system.Case, check: Callable[[int, str], None]) -> None:
        afor: Any = importlib.import_module("asyncio_for_robotics.zenoh")
        self._case = case
        self._check = check
        self._put = pinger(system.zenoh_publisher(session, "ping"), case)
        self._pongs = afor.Sub("pong", session).listen_reliable(queue_size=0)
        self._since = time.perf_counter_ns()

    async def watch(self) -> None:
        """Raise if nothing comes any more."""
        while True:
            await asyncio.sleep(1.0)
            self._check(self._since, "pong")

    async def exchange(self) -> system.Samples:
        """Call the roll, then measure."""
        absent = set(range(2, self._case.nodes + 1))
        calls = asyncio.create_task(self._call_roll())
        while absent:
            absent.discard(-await self._pong())
        calls.cancel()
        now = time.perf_counter_ns
        taken = np.empty(self._case.warm_up + self._case.samples, np.int64)
        for number in range(len(taken)):
            self._since = begin = now()
            self._put(begin, self._case.nodes, number)
            while await self._pong() != number:
                pass
            taken[number] = now() - begin
        return taken[self._case.warm_up :]

    async def _call_roll(self) -> None:
        while True:
            self._put(0, ALL, -1)
            await asyncio.sleep(0.2)

    async def _pong(self) -> int:
        return number_of((await anext(self._pongs)).payload.to_bytes())


async def _run(
    session: Any, case: system.Case, check: Callable[[int, str], None], nodes: range
) -> system.Samples:
    afor: Any = importlib.import_module("asyncio_for_robotics.zenoh")
    async with afor.Scope() as scope:
        sender = _Sender(session, case, check)
        around = [scope.task_group.create_task(sender.watch())]
        around += [
            scope.task_group.create_task(_listen(node, session, large=case.case != "small"))
            for node in nodes
        ]
        samples = await sender.exchange()
        for task in around:
            task.cancel()
    return samples


def serve(job: Job) -> None:
    """Be a node."""
    zenoh: Any = importlib.import_module("zenoh")
    with zenoh.open(system.zenoh_config(connect=job.address)) as session:
        uvloop.run(_listen(job.node, session, large=job.case != "small"))


def measure(case: system.Case) -> system.Samples:
    """Measure round trips through a single session."""
    zenoh: Any = importlib.import_module("zenoh")
    with zenoh.open(system.zenoh_config()) as session:
        return uvloop.run(_run(session, case, Crew({}).check, range(2, case.nodes + 1)))


def measure_processes(case: system.Case) -> system.Samples:
    """Measure round trips between processes."""
    zenoh: Any = importlib.import_module("zenoh")
    locator = f"tcp/127.0.0.1:{system.free_port()}"
    with (
        zenoh.open(system.zenoh_config(listen=locator)) as session,
        children(__name__, case, locator) as crew,
    ):
        return uvloop.run(_run(session, case, crew.check, range(0)))


_PACKAGES = system.packaged(
    asyncio_for_robotics="asyncio-for-robotics", zenoh="eclipse-zenoh", uvloop="uvloop"
)

SYSTEMS = (
    system.System(
        "asyncio-for-robotics (one session)",
        ("stream",),
        measure,
        slowness=30,
        cases=("small", "large"),
        **_PACKAGES,
    ),
    system.in_processes(
        "asyncio-for-robotics (tcp)", ("stream",), measure_processes, 250, **_PACKAGES
    ),
)
