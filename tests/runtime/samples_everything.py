"""Nodes for a file with everything in it that could make equal runs differ."""

from __future__ import annotations

import asyncio
import contextlib
import time

import msgspec

from events import Event
from runtime import Input, Node, NodeConfig, Output, Tick, every, on
from runtime.changeable import Changeable
from runtime.workers.worker import Worker
from tests.runtime.samples_runs import supervisor_of


class Word(Event):
    """Something is said, and what its speaker drew by lot."""

    text: str
    lot: int = 0


class Gains(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that change together."""

    roll: float = 1.0
    pitch: float = 1.0
    yaw: float = 1.0
    thrust: float = 1.0
    drag: float = 1.0


class TalkerConfig(NodeConfig):
    """Its settings."""

    gains: Changeable[Gains] = Gains()
    rate: float = 50.0


class Talker(Node[TalkerConfig]):
    """Speaks at a rate, and fails now and then."""

    words = Output(Word)

    @every(hz="rate")
    def talk(self, tick: Tick) -> None:
        lot = int(self.rng.integers(1 << 30))
        text = f"{self.restarts} {self.config.gains.roll}"
        self.words.send(Word(stamp=tick.stamp, source=self.name, text=text, lot=lot))
        if tick.index == 20:
            raise RuntimeError("out of order")


class Tuner(Node):
    """Changes many settings at once, again and again."""

    async def run(self) -> None:
        for number in range(2, 8):
            await self.clock.sleep(0.1)
            gains = ", ".join(f"{name} = {number}.5" for name in Gains.__struct_fields__)
            with contextlib.suppress(Exception):  # while the talker is away
                supervisor_of(self).parameters.set(f"talker.gains = {{ {gains} }}")


class Crowd(Node):
    """Has many tasks, all of which speak when they are cancelled."""

    heard = Input(Word, keep="latest")
    words = Output(Word)

    async def run(self) -> None:
        for number in range(12):
            self.start(self.wait(f"started {number}"))
        with contextlib.suppress(ExceptionGroup):
            async with asyncio.TaskGroup() as group:
                for number in range(12):
                    group.create_task(self.wait(f"grouped {number}"))
                group.create_task(self.fail())
        async with asyncio.TaskGroup() as group:
            for number in range(12):
                group.create_task(self.wait(f"last {number}"))

    async def wait(self, text: str) -> None:
        try:
            await asyncio.sleep(1000.0)
        finally:
            self.words.send(Word(stamp=self.clock.now(), source=self.name, text=text))

    async def fail(self) -> None:
        await asyncio.sleep(0.3)
        raise RuntimeError("out of order")


class Slow:
    """Lives in a worker; takes as long as it likes."""

    def double(self, number: int) -> int:
        time.sleep((number % 7) / 1000)  # how long must not matter
        return 2 * number


class Doubler(Node):
    """Has a worker answer what it hears, and a thread think about it."""

    heard = Input(Word, keep="every", bound=4, overflow="drop_oldest")
    words = Output(Word)
    worker_: Worker[Slow]

    async def on_startup(self) -> None:
        self.worker_ = await self.worker(Slow, processes=2, latency=0.013)

    async def run(self) -> None:
        async for word in self.heard:
            doubled = await self.worker_.call(Slow.double, word.lot)
            text = await self.offload_for(0.004, str, doubled)
            self.words.send(Word(stamp=self.clock.now(), source=self.name, text=text))


class Listener(Node):
    """Says what it hears, when it hears it."""

    words = Output(Word)

    @on(Word)
    def hear(self, word: Word) -> None:
        if not word.source.startswith("listener"):
            now = self.clock.now()
            self.words.send(Word(stamp=now, source=self.name, text=f"{word.source} {word.text}"))
