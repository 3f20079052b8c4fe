"""A wire that is slow changes how long a run takes, and nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import re
import threading
from collections.abc import Iterator

import msgspec
import pytest

from extensions.machines.tests.samples import Process, settings
from extensions.machines.tests.test_runs import THREE
from runtime.config.model import Config
from runtime.run.execute import execute

DELAY = 0.01


@contextlib.contextmanager
def slow_wire(to: int, delay: float) -> Iterator[int]:
    """Pass TCP connections on to a port of this machine; yields the port where the wire begins.

    Args:
        to: Where it ends.
        delay: Seconds that everything takes, each way.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="slow wire")
    thread.start()
    wire = _Wire(to, delay)
    try:
        yield asyncio.run_coroutine_threadsafe(wire.begin(), loop).result(10)
    finally:
        asyncio.run_coroutine_threadsafe(wire.end(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


class _Wire:
    def __init__(self, to: int, delay: float) -> None:
        self._to = to
        self._delay = delay
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def begin(self) -> int:
        self._server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    async def end(self) -> None:
        assert self._server is not None
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _connect(self, near: asyncio.StreamReader, back: asyncio.StreamWriter) -> None:
        try:
            far, there = await asyncio.open_connection("127.0.0.1", self._to)
        except OSError:  # nobody is there yet
            back.close()
            return
        for reader, writer in ((near, there), (far, back)):
            late: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
            for work in (self._hear(reader, late), self._say(late, writer)):
                task = asyncio.ensure_future(work)
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _hear(
        self, reader: asyncio.StreamReader, late: asyncio.Queue[tuple[float, bytes]]
    ) -> None:
        now = asyncio.get_running_loop().time
        data = b"-"
        with contextlib.suppress(OSError):
            while data:
                data = await reader.read(1 << 16)
                late.put_nowait((now() + self._delay, data))

    async def _say(
        self, late: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter
    ) -> None:
        now = asyncio.get_running_loop().time
        try:
            while True:
                due, data = await late.get()
                await asyncio.sleep(max(due - now(), 0.0))  # the wire is slow in real time
                if not data:
                    return
                writer.write(data)
        finally:
            writer.close()


def at(config: Config, port: int) -> Config:
    network = msgspec.structs.replace(config.network, meet=f"tcp/127.0.0.1:{port}")
    return msgspec.structs.replace(config, network=network)


def port_of(config: Config) -> int:
    match = re.search(r":(\d+)$", config.network.meet)
    assert match is not None
    return int(match[1])


@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
def test_in_lockstep_the_digest_is_that_of_one_process(shared: bool) -> None:
    """Each process reaches the other where its own file says."""
    config = settings(*THREE, duration=0.2, shared=shared)
    with slow_wire(port_of(config), DELAY) as port:
        here = Process(config, "asker").up()
        there = Process(at(config, port), "one,other")
        alone = execute(config)
        for summary in (here.ended(), there.ended()):
            assert summary.digests == alone.digests
            assert summary.wall_seconds > 10 * DELAY  # there was a wire, and it was used


@pytest.mark.slow
def test_in_real_time_both_clocks_show_the_same() -> None:
    """Though a word takes a while: offsets are measured, and half a round trip is known."""
    config = settings(*THREE, clock="real", duration=0.5)
    with slow_wire(port_of(config), DELAY) as port:
        here = Process(config, "asker").up()
        there = Process(at(config, port), "one,other")
        one, other = here.ended(), there.ended()
    assert one.outputs == other.outputs
    (trip,) = (p.round_trip_ms for p in other.processes if p.round_trip_ms is not None)
    (offset,) = (p.clock_offset_ms for p in other.processes if p.clock_offset_ms is not None)
    assert trip >= 2e3 * DELAY
    assert abs(offset) <= trip / 2  # it is one machine, so 0 is the truth
