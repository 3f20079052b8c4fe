"""Nodes for tests of the supervisor, the command line and signals: small, and they keep a diary."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable

import numpy as np

from events import Announcement, Event, Image, Shutdown
from runtime import Duration, Input, Node, NodeConfig, Output, Tick, every, on

DIARY: list[str] = []
"""What the nodes below did, in order; tests clear it."""


class Ping(Event):
    """Something to hear."""

    count: int = 0


class Pong(Event):
    """An answer to it."""

    count: int = 0


class Offer(Announcement):
    """Something to refuse."""


class Diarist(Node):
    """Writes down each of its phases, and says a farewell."""

    pings = Output(Ping)

    def __init__(self) -> None:
        DIARY.append(f"{self.name} made")

    async def on_startup(self) -> None:
        await asyncio.sleep(0)
        DIARY.append(f"{self.name} up")

    def announce(self) -> Iterable[Announcement]:
        DIARY.append(f"{self.name} announces")
        return [Offer(stamp=0, source=self.name)]

    def on_announcement(self, announcement: Announcement) -> None:
        DIARY.append(f"{self.name} heard of {announcement.source}")

    async def on_ready(self) -> None:
        DIARY.append(f"{self.name} is ready")

    @on(Ping)
    def heard(self, event: Ping) -> None:
        DIARY.append(f"{self.name} heard {event.source}")

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        DIARY.append(f"{self.name} ticks {tick.index}")

    async def run(self) -> None:
        DIARY.append(f"{self.name} runs")

    async def on_shutdown(self) -> None:
        DIARY.append(f"{self.name} down")
        self.pings.send(Ping(stamp=self.clock.now(), source=self.name))


class SpeakerConfig(NodeConfig):
    """Settings of a speaker."""

    rate: float = 10.0
    text: str = ""
    pause: Duration = Duration(0)


class Speaker(Node[SpeakerConfig]):
    """Sends a ping at a rate."""

    pings = Output(Ping)

    @every(hz="rate")
    def speak(self, tick: Tick) -> None:
        self.pings.send(Ping(stamp=tick.stamp, source=self.name, count=tick.index))


class Echo(Node):
    """Answers each ping in five lines."""

    pongs = Output(Pong)

    @on(Ping)
    def answer(self, event: Ping) -> None:
        self.pongs.send(Pong(stamp=event.stamp, source=self.name, count=event.count))


class Reader(Node):
    """Reads pings one by one and writes them into a file of the run's folder."""

    pings = Input(Ping)

    async def run(self) -> None:
        assert self.out is not None
        with (self.out / "pings.txt").open("w", encoding="utf-8") as file:
            async for ping in self.pings:
                file.write(f"{ping.count} {self.rng.random():.6f}\n")


class Noise(Node):
    """Says something random, so that the digest depends on the seed."""

    pings = Output(Ping)

    @every(hz=10)
    def speak(self, tick: Tick) -> None:
        count = int(self.rng.integers(1 << 30))
        self.pings.send(Ping(stamp=tick.stamp, source=self.name, count=count))


class Ender(Node):
    """Ends the run with an event after half a second."""

    end = Output(Shutdown)

    async def run(self) -> None:
        await self.clock.sleep(0.5)
        self.end.send(Shutdown(stamp=self.clock.now(), source=self.name, reason="enough"))


class Failing(Node):
    """Fails after half a second."""

    async def run(self) -> None:
        await self.clock.sleep(0.5)
        raise RuntimeError("out of order")


class SlowStart(Node):
    """Takes a minute to start, and says on standard output when it begins."""

    async def on_startup(self) -> None:
        print("starting", flush=True)
        await asyncio.get_running_loop().create_future()


class SlowEnd(Node):
    """Runs until it is told to stop, and then never ends; says so on standard output."""

    async def run(self) -> None:
        print("running", flush=True)
        await asyncio.get_running_loop().create_future()

    async def on_shutdown(self) -> None:
        print("ending", flush=True)
        await asyncio.get_running_loop().create_future()


class Stuck(Node):
    """Has a thread that never returns, and says its process's number."""

    async def run(self) -> None:
        print(f"running {os.getpid()}", flush=True)
        await self.offload(time.sleep, 1000)


class Lively(Speaker):
    """Speaks, and says on standard output when it has begun."""

    async def run(self) -> None:
        print("running", flush=True)


class Painter(Node):
    """Sends one small image."""

    images = Output(Image)

    async def run(self) -> None:
        data = np.zeros((4, 6, 3), np.uint8)
        self.images.send(Image(stamp=0, source=self.name, frame_id="easel", data=data))
