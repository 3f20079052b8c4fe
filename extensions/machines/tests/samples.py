"""Nodes that talk across processes, and several of these in one: each on a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from events import Announcement, Event, Image
from runtime import Input, Node, NodeConfig, Output, RefusedError, Tick, every, on
from runtime.channels.hold import Hold, HoldConfig
from runtime.config.model import Config
from runtime.config.reading import parse
from runtime.run.execute import execute
from runtime.run.supervisor import Supervisor
from runtime.summary import Summary
from tests.runtime.ports import free_port


class Asked(Event):
    """A question."""

    count: int = 0


class Answered(Event):
    """An answer, and what the answerer had heard until then."""

    count: int
    heard: tuple[str, ...]


class Offer(Announcement):
    """Something to hear of before the run."""

    rate: float


class Asker(Node):
    """Asks at a rate, tells whose answers it heard, and shows images."""

    questions = Output(Asked)
    images = Output(Image)
    answers = Input(Answered)

    async def on_startup(self) -> None:
        self.log.info("was here %d times", self.restarts)

    def announce(self) -> Iterable[Announcement]:
        return [Offer(stamp=0, source=self.name, rate=50.0)]

    @every(hz=50)
    def ask(self, tick: Tick) -> None:
        self.questions.send(Asked(stamp=tick.stamp, source=self.name, count=tick.index))
        if tick.index % 10 == 0:
            data = self.rng.integers(0, 255, (40, 60, 3), np.uint8)
            self.images.send(Image(stamp=tick.stamp, source=self.name, frame_id="f", data=data))

    async def run(self) -> None:
        async for answer in self.answers:
            self.log.debug("%s", answer)

    async def on_shutdown(self) -> None:
        self.questions.send(Asked(stamp=self.clock.now(), source=self.name, count=-1))


class AnswererConfig(NodeConfig):
    """Settings of an answerer."""

    takes: float = 0.005
    handles: bool = False


class Answerer(Node[AnswererConfig]):
    """Answers after a while; says what it has heard of everything, in order."""

    questions = Input(Asked, keep="latest")
    answers = Output(Answered)

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.offers: list[str] = []

    async def on_startup(self) -> None:
        self.log.info("was here %d times", self.restarts)

    def on_announcement(self, announcement: Announcement) -> None:
        self.offers.append(f"{announcement.source}: {announcement}")

    @on(Asked, Answered, Image)
    def receives(self, event: Event) -> bool:
        self.heard.append(f"{type(event).__name__} {event.source} {event.stamp}")
        return self.config.handles

    @every(hz=50)
    def tick(self, tick: Tick) -> None:
        self.heard.append(f"tick {tick.index}")

    async def run(self) -> None:
        async for question in self.questions:
            seen = tuple(self.heard)
            self.heard.clear()
            await self.offload_for(self.config.takes, time.sleep, 0.0001)
            self.answers.send(
                Answered(
                    stamp=question.stamp,
                    source=self.name,
                    count=question.count,
                    heard=(*self.offers, *seen),
                )
            )


class Outside(Answerer):
    """Has its answers from a system outside, for which time is held."""

    async def on_startup(self) -> None:
        self.outside: Hold[int] = self.hold(self.name, HoldConfig(), self.config.takes)

    async def run(self) -> None:
        async for question in self.questions:
            seen = tuple(self.heard)
            self.heard.clear()
            owed = self.outside.owe(question.stamp)
            call = (question.stamp, question.count)
            threading.Timer(0.001 * (question.count % 3), self.outside.answer, call).start()
            count = await owed
            assert count is not None
            self.answers.send(
                Answered(stamp=question.stamp, source=self.name, count=count, heard=seen)
            )


class Refuser(Node):
    """Fails in the middle."""

    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        if tick.index == 3:
            raise RefusedError(self.name, "no more")


def settings(
    *nodes: tuple[str, str, dict[str, Any]],
    meet: str = "",
    wait: float = 20,
    shared: bool = True,
    **run: Any,
) -> Config:
    """Return a configuration of nodes of this module: name, class, settings."""
    table = {
        "run": {"name": "apart", "duration": 1.0} | run,
        "network": {
            "meet": meet or f"tcp/127.0.0.1:{free_port()}",
            "wait": wait,
            "shared": shared,
            "lease": 5,  # under load, Zenoh's threads may be late
        },
        "nodes": [{"name": name, "type": f"{__name__}:{cls}", **rest} for name, cls, rest in nodes],
    }
    return parse(table, "test.toml")


class Process(threading.Thread):
    """Some nodes of a configuration, on a thread; what a process would do."""

    def __init__(self, config: Config, only: str, out: Path | None = None) -> None:
        super().__init__(name=only, daemon=True)
        self.summary: Summary | None = None
        self.error: Exception | None = None
        self._config = config
        self._only = only.split(",")
        self._out = out
        self._up = threading.Event()
        self.start()

    def run(self) -> None:
        try:
            self.summary = execute(self._config, self._out, only=self._only, watch=self._watch)
        except Exception as error:
            self.error = error

    def up(self) -> Process:
        """Wait until it has begun to look for the others."""
        assert self._up.wait(10)
        return self

    @contextlib.contextmanager
    def _watch(self, supervisor: Supervisor) -> Iterator[None]:
        self._up.set()
        yield

    def done(self, timeout: float = 30) -> Process:
        self.join(timeout)
        assert not self.is_alive(), f"{self.name} still runs"
        return self

    def ended(self) -> Summary:
        self.done()
        if self.error is not None:
            raise self.error
        assert self.summary is not None
        return self.summary


def apart(config: Config, *onlys: str) -> list[Summary]:
    """Run each group of nodes in a process of its own; return what each says in the end."""
    return [process.ended() for process in [Process(config, only) for only in onlys]]


class FailerConfig(NodeConfig):
    """When to fail."""

    when: Literal["on_startup", "announce", "on_announcement", "run"]


class Failer(Node[FailerConfig]):
    """Fails in one of the phases."""

    async def on_startup(self) -> None:
        self._reach("on_startup")

    def announce(self) -> Iterable[Announcement]:
        self._reach("announce")
        return []

    def on_announcement(self, announcement: Announcement) -> None:
        self._reach("on_announcement")

    async def run(self) -> None:
        self._reach("run")

    def _reach(self, phase: str) -> None:
        if self.config.when == phase:
            raise RefusedError(self.name, f"wrong world in {phase}")


class Slowly(Node[Any]):
    """Takes its time to start and to end; says where it is."""

    async def on_startup(self) -> None:
        self.log.info("phase start-up")
        await asyncio.to_thread(time.sleep, 0.5)

    def announce(self) -> Iterable[Announcement]:
        self.log.info("phase begin")
        return super().announce()

    async def run(self) -> None:
        self.log.info("phase run")
        await super().run()

    async def on_shutdown(self) -> None:
        self.log.info("phase shut-down")
        await asyncio.to_thread(time.sleep, 0.5)


class Slow(Slowly, Asker):
    """Asks, slowly."""


class SlowAnswerer(Slowly, Answerer):
    """Answers, slowly."""


class Restless(Asker):
    """Asks, and looks at the time again and again from its start-up on."""

    async def on_startup(self) -> None:
        self.start(self._look())

    async def _look(self) -> None:
        while True:
            await self.clock.sleep(0.01)
