"""Nodes that go wrong in every way and place, for runs in processes of their own.

``[[nodes]] type = "tests.runtime.samples_faults:Faulty"``, with `place` and `way`.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, NoReturn

from events import Announcement
from runtime import Node, NodeConfig, Output, Tick, every, on
from tests.runtime.samples import Offer, Ping
from tests.runtime.samples_runs import supervisor_of

PLACES = (
    "on_startup",
    "announce",
    "on_announcement",
    "check",
    "on_ready",
    "run",
    "handler",
    "tick",
    "started",
    "task_group",
    "offload",
    "on_shutdown",
    "after_run",
)

WAYS: dict[str, Callable[[], BaseException]] = {
    "RuntimeError": lambda: RuntimeError("out of order"),
    "ExceptionGroup": lambda: ExceptionGroup("some", [KeyError("a"), ValueError("b")]),
    "SystemExit": lambda: SystemExit(3),
    "KeyboardInterrupt": KeyboardInterrupt,
    "CancelledError": asyncio.CancelledError,
    "GeneratorExit": GeneratorExit,
    "StopIteration": StopIteration,
    "BaseException": lambda: BaseException("of the very base"),
}


class FaultyConfig(NodeConfig):
    """Where and how it goes wrong, once."""

    place: str = "run"
    way: str = "RuntimeError"


class Faulty(Node[FaultyConfig]):
    """Goes wrong in its first life, at 0.2 s or in the step that it is told."""

    pings = Output(Ping)

    def trouble(self, place: str) -> None:
        late = PLACES.index("run") <= PLACES.index(place) < PLACES.index("after_run")
        if place != self.config.place or self.restarts or (late and self.clock.now() < 2e8):
            return
        error = WAYS[self.config.way]()
        raise error

    async def on_startup(self) -> None:
        self.after_run(self.afterwards)
        self.trouble("on_startup")

    def announce(self) -> Iterable[Announcement]:
        self.trouble("announce")
        return [Offer(stamp=0, source=self.name)]

    def on_announcement(self, announcement: Announcement) -> None:
        self.trouble("on_announcement")

    def check(self) -> Iterable[str]:
        self.trouble("check")
        return ()

    async def on_ready(self) -> None:
        self.trouble("on_ready")

    @on(Ping)
    def listen(self, _: Ping) -> None:
        self.trouble("handler")

    @every(hz=20)
    def tick(self, tick: Tick) -> None:
        self.trouble("tick")

    async def run(self) -> None:
        self.start(self.later("started"))
        async with asyncio.TaskGroup() as group:
            group.create_task(self.later("task_group"))
        await self.offload(self.trouble, "offload")
        await self.later("run")

    async def later(self, place: str) -> None:
        await self.clock.sleep(0.2)
        self.trouble(place)

    async def on_shutdown(self) -> None:
        self.trouble("on_shutdown")

    def afterwards(self, folder: Path) -> None:
        self.trouble("after_run")


class Witness(Node):
    """Speaks, counts, and writes down at the end what it has seen; also after the run."""

    pings = Output(Ping)
    count = 0

    async def on_startup(self) -> None:
        self.after_run(self.afterwards)

    @every(hz=20)
    def speak(self, tick: Tick) -> None:
        self.pings.send(Ping(stamp=tick.stamp, source=self.name, count=tick.index))
        self.count += 1

    async def on_shutdown(self) -> None:
        assert self.out is not None
        (self.out / f"{self.name}.txt").write_text(f"{self.count}\n", encoding="utf-8")
        self.conclude(self.name, {"count": self.count})

    def afterwards(self, folder: Path) -> None:
        (folder / f"{self.name}.after").write_text("called\n", encoding="utf-8")


class StubbornConfig(NodeConfig):
    """What it does instead of ending."""

    place: Literal["on_startup", "on_ready", "run", "on_shutdown", "started late"] = "run"
    way: str = "swallow"


class Stubborn(Node[StubbornConfig]):
    """Does not end, in one of many ways."""

    async def on_startup(self) -> None:
        await self.stay("on_startup")

    async def on_ready(self) -> None:
        await self.stay("on_ready")

    async def run(self) -> None:
        await self.clock.sleep(0.1)
        print("running", flush=True)
        await self.stay("run")
        await asyncio.get_running_loop().create_future()

    async def on_shutdown(self) -> None:
        if self.config.place == "started late":
            self.start(self.swallow())
        await self.stay("on_shutdown")

    async def stay(self, place: str) -> None:
        if self.config.place == place:
            await getattr(self, self.config.way)()

    async def swallow(self) -> NoReturn:
        while True:
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.get_running_loop().create_future()

    async def spin(self) -> NoReturn:
        while True:
            with contextlib.suppress(BaseException):
                await asyncio.sleep(0)

    async def block(self) -> None:
        while True:
            sum(range(1000))

    async def sleep(self) -> None:
        time.sleep(1000)  # noqa: ASYNC251  # that is the fault

    async def wait_for_thread(self) -> None:
        await self.offload(threading.Event().wait)

    async def threads(self) -> None:
        calls: list[Any] = [self.offload(threading.Event().wait) for _ in range(8)]
        await asyncio.gather(*calls)


class Remover(Node):
    """Removes the run's folder while it goes on."""

    async def run(self) -> None:
        assert self.out is not None
        shutil.rmtree(self.out)


class Replacer(Node):
    """Puts a file in the place of the run's folder."""

    async def run(self) -> None:
        assert self.out is not None
        shutil.rmtree(self.out)
        self.out.touch()


class PhasedConfig(NodeConfig):
    """In which phase it stays for a while, or until the run ends."""

    phase: str = "wait"


class Phased(Node[PhasedConfig]):
    """Says on standard output that it is in a phase, and stays there."""

    ticked = False

    def now_in(self, phase: str) -> bool:
        if self.config.phase == phase:
            print(phase, flush=True)
        return self.config.phase == phase

    async def on_startup(self) -> None:
        if self.now_in("start"):
            await asyncio.get_running_loop().create_future()

    @every(hz=100)
    def tick(self, tick: Tick) -> None:
        if tick.index >= 5 and not self.ticked:  # in real time, any one may be missed
            self.ticked = True
            self.now_in("tick")

    async def run(self) -> None:
        if self.config.phase == "shutdown":
            self.stop("enough")
        if self.now_in("busy"):
            await self.spin()
        if self.now_in("offload"):
            await self.offload(self.outlast_signal)
        if self.now_in("wait"):
            await asyncio.get_running_loop().create_future()

    async def spin(self) -> None:
        end = asyncio.get_running_loop().time() + 3600
        while asyncio.get_running_loop().time() < end:  # noqa: ASYNC110
            await asyncio.sleep(0.001)

    async def on_shutdown(self) -> None:
        if self.now_in("shutdown"):
            await asyncio.to_thread(self.outlast_signal)

    def outlast_signal(self) -> None:
        state = supervisor_of(self).state
        while not state.stop_requested:
            time.sleep(0.01)
        time.sleep(0.3)  # real: a thread knows no other time
