"""A loop that stands is reported with its node and line; one that waits is left alone."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import queue
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import uvloop

from runtime import Node, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.run import event_loop as task_factory
from runtime.run.execute import make_clock, make_loop
from runtime.run.supervisor import Supervisor
from runtime.run.watchdogs import LoopWatchdog
from runtime.summary import Stall
from runtime.testing import spec
from runtime.time.lockstep import LockstepLoop
from runtime.units import Duration

pytestmark = pytest.mark.timeout(20)
LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {
    "asyncio": asyncio.new_event_loop,
    "uvloop": uvloop.new_event_loop,
    "lockstep": LockstepLoop,
    "paced": lambda: LockstepLoop(1.0),
}


class Blocker(Node):
    """Blocks the loop at its third tick, in the way it is told."""

    way: ClassVar[str] = "sleep"
    line: ClassVar[int] = 0

    @every(hz=20)
    def block(self, tick: Tick) -> None:
        if tick.index != 2:
            return
        frame = inspect.currentframe()
        assert frame is not None
        type(self).line = frame.f_lineno + 2
        if self.way == "sleep":
            time.sleep(0.06)  # a stall is what is tested
        elif self.way == "lock":
            threading.Event().wait(0.06)
        elif self.way == "queue":
            self.wait_for_a_queue()
        else:
            subprocess.run(["sleep", "0.06"], check=True)

    def wait_for_a_queue(self) -> None:
        with contextlib.suppress(queue.Empty):
            queue.Queue[int]().get(timeout=0.06)


class Patient(Node):
    """Waits without blocking."""

    async def run(self) -> None:
        await self.clock.sleep(0.1)
        await self.offload(time.sleep, 0.15)


def watch(*nodes: type[Node[Any]], clock: str, duration: float = 0.25) -> LoopWatchdog:
    """Run nodes under a watchdog with a limit of 40 ms."""
    run: Any = {"clock": clock, "duration": Duration(duration), "speed": 1.0}
    config = Config(run=RunConfig(**run), nodes=tuple(spec(n, n.__name__) for n in nodes))
    loop = make_loop(config.run)
    dogs: list[LoopWatchdog] = []

    async def main() -> None:
        task_factory.install(loop)
        dogs.append(LoopWatchdog(loop, 0.04, reports.append))
        kept = make_clock(config.run, loop)
        dogs[0].start()
        await Supervisor(config, kept).main()
        dogs[0].stop()
        kept.close()

    reports: list[Stall] = []
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(main())
    assert len(reports) == sum(dogs[0].stalls.values())
    return dogs[0]


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("way", ["sleep", "lock", "queue", "child"])
def test_a_blocking_handler_is_reported_with_node_and_line(clock: str, way: str) -> None:
    Blocker.way = way
    dog = watch(Patient, Blocker, clock=clock)
    assert dog.stalls["Blocker"] == 1
    stall = dog.longest["Blocker"]
    assert __file__ in stall.line
    assert ("in wait_for_a_queue" if way == "queue" else "in block") in stall.line
    assert 0.04 < stall.seconds < 5


@pytest.mark.slow
def test_the_line_is_the_one_that_blocks() -> None:
    Blocker.way = "sleep"
    dog = watch(Blocker, clock="real")
    assert dog.longest["Blocker"].line == f"{__file__}:{Blocker.line} in block"


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_awaiting_slow_work_is_no_stall(clock: str) -> None:
    assert watch(Patient, clock=clock).stalls["Patient"] == 0


class CountingLoop:
    """Passes calls on to a loop and counts those that wake it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.woken = 0

    def call_soon_threadsafe(self, call: Callable[..., object], *args: object) -> None:
        self.woken += 1
        self.loop.call_soon_threadsafe(call, *args)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("busy", [False, True])
def test_only_a_busy_loop_is_woken(name: str, busy: bool) -> None:
    async def main() -> int:
        counting: Any = CountingLoop(asyncio.get_running_loop())
        dog = LoopWatchdog(counting, 0.02, lambda _: None)
        dog.start()
        end = time.monotonic() + 0.2
        while busy and time.monotonic() < end:
            sum(range(1000))
        if not busy:  # real time in which nothing happens, on any loop
            await asyncio.get_running_loop().run_in_executor(None, time.sleep, 0.2)
        dog.stop()
        return int(counting.woken)

    with asyncio.Runner(loop_factory=LOOPS[name]) as runner:
        woken = runner.run(main())
    assert woken > 0 if busy else woken <= 3  # of 40 looks; the first may find it starting


def test_a_closed_loop_ends_the_watch() -> None:
    loop = asyncio.new_event_loop()
    dog = LoopWatchdog(loop, 0.02, lambda _: None)
    loop.close()
    dog.start()
    dog._thread.join(1.0)
    assert not dog._thread.is_alive()


def test_a_long_limit_does_not_hold_up_the_end() -> None:
    """A watchdog with a limit of an hour stops within a moment of being told to."""
    dog = LoopWatchdog(asyncio.new_event_loop(), 3600.0, lambda _: None)
    try:
        dog.start()
        stopping = threading.Thread(target=dog.stop)
        stopping.start()
        stopping.join(5.0)
        assert not stopping.is_alive()
    finally:
        dog._loop.close()


def test_a_limit_of_none_watches_nothing() -> None:
    """With a limit of 0 there is no thread, and stopping is no mistake."""
    loop = asyncio.new_event_loop()
    dog = LoopWatchdog(loop, 0.0, lambda _: None)
    before = threading.active_count()
    dog.start()
    assert threading.active_count() == before
    dog.stop()
    loop.close()
