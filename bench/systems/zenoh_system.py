"""Zenoh, and asyncio-for-robotics over it: in a single session, and in processes over TCP.

What Zenoh passes is bytes, in one process too. A large ping has its header as attachment and the
array as payload: `put` copies it in, each receiver copies it out into bytes, and the memory of each
copy is new to the process, which costs more than the copying. Publishers are express: they send at
once, batching nothing.

In one process all subscribers of Zenoh's own belong to one session and their callbacks run within
`put` (a way that Zenoh calls unstable; its usual way is a thread). Between processes, nodes connect
to node 1 alone, without scouting, and answer from the callback; node 1 waits on a
`queue.SimpleQueue`. Large payloads then travel through shared memory where Zenoh sees fit, as is
its default.

Nodes of asyncio-for-robotics, on uvloop, wait in `Sub.listen_reliable`, which skips nothing, and
send with Zenoh itself, as the library means it. Messages, sessions and their settings are the same;
Zenoh hands them to a thread, and that to the loop, in one process too; there, as between processes,
the last node's reply may be there before all others have the ping.
"""

from __future__ import annotations

import asyncio
import importlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import uvloop

from bench import system
from bench.systems.children import (
    ALL,
    PING,
    PONG,
    Crew,
    Job,
    PeerError,
    children,
    number_of,
    reply_to,
)


def pinger(pings: Any, case: system.Case) -> Callable[[int, int, int], None]:
    """Return a function to put a ping, given its stamp, receiver and number."""
    if case.case == "small":
        return lambda stamp, receiver, number: pings.put(PING.pack(stamp, 1, receiver, number))
    # Zenoh takes bytearrays, which an array may be a view of, but no arrays.
    frame = bytearray(system.large_array().tobytes())
    return lambda stamp, receiver, number: pings.put(
        frame, attachment=PING.pack(stamp, 1, receiver, number)
    )


def header(sample: Any, *, large: bool) -> bytes:
    """Return the header of a ping; make an array of the payload of a large ping."""
    payload: bytes = sample.payload.to_bytes()
    if not large:
        return payload
    np.frombuffer(payload, np.float32).reshape(system.LARGE_SHAPE)
    attachment: bytes = sample.attachment.to_bytes()
    return attachment


def measure_callbacks(case: system.Case) -> system.Samples:
    """Measure round trips through the callbacks of a single session."""
    with system.zenoh_session() as session:
        pings, pongs = (system.zenoh_publisher(session, key) for key in ("ping", "pong"))
        large = case.case != "small"
        latest, landed = -1, 0
        now = time.perf_counter_ns

        def listen(node: int) -> Any:
            def ping(sample: Any) -> None:
                _, _, receiver, number = PING.unpack(header(sample, large=large))
                if receiver == node:
                    pongs.put(PONG.pack(0, number))

            return system.zenoh_subscriber(session, "ping", ping)

        def pong(sample: Any) -> None:
            nonlocal latest, landed
            latest = number_of(sample.payload.to_bytes())
            landed = now()

        _kept = [listen(node) for node in range(2, case.nodes + 1)]
        _kept.append(system.zenoh_subscriber(session, "pong", pong))
        put = pinger(pings, case)
        taken = np.empty(case.warm_up + case.samples, np.int64)
        for number in range(len(taken)):
            begin = now()
            put(begin, case.nodes, number)
            if latest != number:
                raise PeerError(f"zenoh: ping {number} was not answered within put")
            taken[number] = landed - begin
        return taken[case.warm_up :]


def serve(job: Job) -> None:
    """Be a node."""
    large = job.case != "small"
    with system.zenoh_session(connect=job.address) as session:
        if job.variant == _ROBOTICS:
            uvloop.run(_listen(job.node, session, large=large))
            return
        pongs = system.zenoh_publisher(session, "pong")

        def ping(sample: Any) -> None:
            pong = reply_to(job.node, header(sample, large=large))
            if pong is not None:
                pongs.put(pong)

        _kept = session.declare_subscriber("ping", ping)
        threading.Event().wait()


def measure_processes(case: system.Case) -> system.Samples:
    """Measure round trips between processes."""
    locator = f"tcp/127.0.0.1:{system.free_port()}"
    with system.zenoh_session(listen=locator) as session:
        pings = system.zenoh_publisher(session, "ping")
        numbers: queue.SimpleQueue[int] = queue.SimpleQueue()

        def pong(sample: Any) -> None:
            numbers.put(number_of(sample.payload.to_bytes()))

        _kept = session.declare_subscriber("pong", pong)

        def receive() -> int | None:
            try:
                return numbers.get(timeout=1.0)
            except queue.Empty:
                return None

        with children(__name__, case, locator) as crew:
            return crew.exchange(case, pinger(pings, case), receive)


def _robotics() -> Any:
    return importlib.import_module("asyncio_for_robotics.zenoh")


async def _listen(node: int, session: Any, *, large: bool) -> None:
    pongs = system.zenoh_publisher(session, "pong")
    pings = _robotics().Sub("ping", session)
    async for sample in pings.listen_reliable(queue_size=0):
        pong = reply_to(node, header(sample, large=large))
        if pong is not None:
            pongs.put(pong)


async def _exchange(session: Any, case: system.Case, crew: Crew, group: Any) -> system.Samples:
    """Call the roll, then measure."""
    put = pinger(system.zenoh_publisher(session, "ping"), case)
    pongs = _robotics().Sub("pong", session).listen_reliable(queue_size=0)
    now = time.perf_counter_ns

    async def pong() -> int:
        return number_of((await anext(pongs)).payload.to_bytes())

    async def call_roll() -> None:
        begin = now()
        while True:
            crew.check(begin, "answers to the roll call")
            put(0, ALL, -1)
            await asyncio.sleep(0.2)

    calls = group.create_task(call_roll())
    absent = set(range(2, case.nodes + 1))
    while absent:
        absent.discard(-await pong())
    calls.cancel()
    taken = np.empty(case.warm_up + case.samples, np.int64)
    for number in range(len(taken)):
        begin = now()
        put(begin, case.nodes, number)
        while await pong() != number:
            pass
        taken[number] = now() - begin
    return taken[case.warm_up :]


async def _run(session: Any, case: system.Case, crew: Crew, nodes: range) -> system.Samples:
    async with _robotics().Scope() as scope:
        listeners = [
            scope.task_group.create_task(_listen(node, session, large=case.case != "small"))
            for node in nodes
        ]
        samples = await _exchange(session, case, crew, scope.task_group)
        for listener in listeners:
            listener.cancel()
    return samples


def measure_robotics(case: system.Case) -> system.Samples:
    """Measure round trips of asyncio-for-robotics through a single session."""
    with system.zenoh_session() as session:
        return uvloop.run(_run(session, case, Crew(), range(2, case.nodes + 1)))


def measure_robotics_processes(case: system.Case) -> system.Samples:
    """Measure round trips of asyncio-for-robotics between processes."""
    locator = f"tcp/127.0.0.1:{system.free_port()}"
    with (
        system.zenoh_session(listen=locator) as session,
        children(__name__, case, locator, _ROBOTICS) as crew,
    ):
        return uvloop.run(_run(session, case, crew, range(0)))


_ROBOTICS = "asyncio-for-robotics"
_PACKAGE = system.packaged(zenoh="eclipse-zenoh")
_PACKAGES = system.packaged(asyncio_for_robotics=_ROBOTICS, zenoh="eclipse-zenoh", uvloop="uvloop")
_COPIED = system.COPIED_CASES

SYSTEMS = (
    system.System(
        f"{_ROBOTICS} (one session)", ("stream",), measure_robotics, 30, _COPIED, **_PACKAGES
    ),
    system.in_processes(
        f"{_ROBOTICS} (tcp)", ("stream",), measure_robotics_processes, 250, **_PACKAGES
    ),
    system.System("zenoh (one session)", ("handler",), measure_callbacks, 4, _COPIED, **_PACKAGE),
    system.in_processes("zenoh (tcp)", ("handler",), measure_processes, 200, **_PACKAGE),
)
