"""Zenoh: a single session with callbacks, and peers in processes over TCP on the loopback.

What Zenoh passes is bytes, in one process too. A large ping has its header as attachment and the
array as payload: `put` copies it in, each receiver copies it out into bytes, and the memory of each
copy is new to the process, which costs more than the copying. Publishers are express: they send at
once, batching nothing.

In one process all subscribers belong to one session and their callbacks run within `put` (a way
that Zenoh calls unstable; its usual way is a thread). Between processes, nodes connect to node 1
alone, without scouting, and answer from the callback; node 1 waits on a `queue.SimpleQueue`. Large
payloads then travel through shared memory where Zenoh sees fit, as is its default.
"""

from __future__ import annotations

import importlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench import system
from bench.systems.children import PING, PONG, Job, PeerError, children, number_of, reply_to


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
    zenoh: Any = importlib.import_module("zenoh")
    with zenoh.open(system.zenoh_config()) as session:
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
    zenoh: Any = importlib.import_module("zenoh")
    large = job.case != "small"
    with zenoh.open(system.zenoh_config(connect=job.address)) as session:
        pongs = system.zenoh_publisher(session, "pong")

        def ping(sample: Any) -> None:
            pong = reply_to(job.node, header(sample, large=large))
            if pong is not None:
                pongs.put(pong)

        _kept = session.declare_subscriber("ping", ping)
        threading.Event().wait()


def measure_processes(case: system.Case) -> system.Samples:
    """Measure round trips between processes."""
    zenoh: Any = importlib.import_module("zenoh")
    locator = f"tcp/127.0.0.1:{system.free_port()}"
    with zenoh.open(system.zenoh_config(listen=locator)) as session:
        pings = system.zenoh_publisher(session, "ping")
        heard: queue.SimpleQueue[int] = queue.SimpleQueue()

        def pong(sample: Any) -> None:
            heard.put(number_of(sample.payload.to_bytes()))

        _kept = session.declare_subscriber("pong", pong)

        def receive() -> int | None:
            try:
                return heard.get(timeout=1.0)
            except queue.Empty:
                return None

        with children(__name__, case, locator) as crew:
            return crew.exchange(case, pinger(pings, case), receive)


_PACKAGE = system.packaged(zenoh="eclipse-zenoh")

SYSTEMS = (
    system.System(
        "zenoh (one session)",
        ("handler",),
        measure_callbacks,
        slowness=4,
        cases=("small", "large"),
        **_PACKAGE,
    ),
    system.in_processes("zenoh (tcp)", ("handler",), measure_processes, 200, **_PACKAGE),
)
