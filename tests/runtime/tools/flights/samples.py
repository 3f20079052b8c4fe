"""Nodes that fly without any physics, in all ways in which the loop gets into a node."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from events import Announcement, Event, VehicleAnnouncement
from runtime import Bundle, Duration, Input, Node, NodeConfig, Output, Tick, every, on
from runtime.config.model import Config
from runtime.config.reading import load
from runtime.run.execute import execute
from runtime.summary import Summary


class Seen(Event):
    """What a sensor has measured."""

    number: float
    data: npt.NDArray[np.uint8]


class Felt(Event):
    """What a sensor has measured more often."""

    number: float


class Echo(Event):
    """What the craft says of an order."""

    number: float


class Order(Event):
    """What a pilot wants."""

    number: float


class Guess(Event):
    """What an estimator makes of it."""

    number: float


class Look(NamedTuple):
    """What a lens answers."""

    number: float
    data: npt.NDArray[np.uint8]


class Lens:
    """What measures, in a process of its own, and remembers how often."""

    def __init__(self) -> None:
        self.calls = 0

    def mean(self, data: npt.NDArray[np.uint8]) -> Look:
        """Return a mean, with the picture, each darker than the one before."""
        self.calls += 1
        return Look(float(np.mean(data)), data - np.uint8(self.calls % 256))

    def fail(self) -> None:
        """Do not answer."""
        raise LookupError("nothing to be seen")


class CraftConfig(NodeConfig):
    """Settings of a craft."""

    rate: float = 50.0
    latency: Duration = Duration(0.04)
    fail: bool = False
    last_words: bool = False
    lens: bool = True
    signal: bool = False


class Craft(Node[CraftConfig]):
    """Sends what it has seen with a latency, and what it has felt at once."""

    flies = True
    seen = Output(Seen)
    felt = Output(Felt)
    echoes = Output(Echo)

    async def on_startup(self) -> None:
        """Tick at a rate that is a setting."""
        self.heard = 0.0
        if not self.config.lens:
            return
        self.lens = await self.worker(Lens)
        try:
            await self.lens.call(Lens.fail)
        except LookupError as error:
            self.note_environment("craft", str(error))
        self.every(self.config.rate, self.look, "look")

    def announce(self) -> Iterable[Announcement]:
        """Announce a vehicle."""
        yield VehicleAnnouncement(
            stamp=0, source=self.name, mass=1.0, max_thrust=2.0, control_rate=100.0,
            position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0),
        )  # fmt: skip

    @every(hz=100)
    def feel(self, tick: Tick) -> None:
        """Measure at once."""
        if self.config.fail and tick.index == 20:
            raise RuntimeError("out of order")
        if self.config.signal and tick.index == 20:
            os.kill(os.getpid(), signal.SIGTERM)
        number = self.rng.random() + self.heard
        self.felt.send(Felt(stamp=tick.stamp, source=self.name, number=number))

    def look(self, tick: Tick) -> None:
        """Measure, and tell later."""
        if not self.config.lens:
            return
        self.start(self._tell(tick.stamp, self.rng.integers(0, 256, (8, 9, 3), np.uint8)))

    async def _tell(self, stamp: int, data: npt.NDArray[np.uint8]) -> None:
        number, darker = await self.lens.call_for(self.config.latency, Lens.mean, data)
        await self.offload(np.mean, data)
        event = Seen(stamp=stamp, source=self.name, number=number, data=darker)
        self.seen.send(event)
        await asyncio.sleep(0)
        self.echoes.send(Echo(stamp=self.clock.now(), source=f"{self.name}/soon", number=0.0))

    @on(Order)
    def orders(self, order: Order) -> bool:
        """Obey, and say so at once; nobody after it gets each seventh."""
        self.heard += order.number
        heard = round(self.heard) if order.number > 0.5 else self.heard  # whole, or a float
        echo = Echo(stamp=order.stamp, source=f"{self.name}/echo", number=heard)
        self.echoes.send(echo)
        return int(order.number * 1e6) % 7 == 0

    async def on_shutdown(self) -> None:
        """Say a last word."""
        if self.config.last_words:
            self.echoes.send(Echo(stamp=self.clock.now(), source=f"{self.name}/last", number=1.0))


class CaptainConfig(NodeConfig):
    """Settings of a captain."""

    end: float = 1.0


class Captain(Node[CaptainConfig]):
    """Orders by what it sees and feels, in a handler, in its `run`, by asyncio's timers."""

    flies = True
    seen = Input(Seen)
    orders = Output(Order)

    @on(Felt)
    def felt(self, event: Felt) -> None:
        """Order at once now and then."""
        if event.number % 1.0 < 0.3:
            self._order(event.number % 1.0)

    async def run(self) -> None:
        """Order in between, and end the run."""
        self.start(self._by_timers())
        self._order(0.5)
        while self.clock.now() < self.config.end * 1e9:
            seen = await self.seen.receive()
            self._order(seen.number / 255)
            await self.clock.sleep(0.03)
            self._order(self.rng.random())
        self.stop("the captain has gone")

    async def _by_timers(self) -> None:
        while True:
            await asyncio.sleep(0.07)
            self._order(0.25)
            await self.offload(np.mean, np.ones(3))
            self._order(0.75)

    def _order(self, number: float) -> None:
        self.orders.send(Order(stamp=self.clock.now(), source=self.name, number=number))


class Pair(NamedTuple):
    """What belongs together."""

    seen: Seen
    felt: tuple[Felt, ...]


class GuesserConfig(NodeConfig):
    """Settings of an estimator."""

    latency: Duration = Duration(0.04)
    feed_back: bool = False
    end: float = 0.0


class Guesser(Node[GuesserConfig]):
    """Takes the newest as it is ready for it, so that its order with other things matters."""

    pairs = Bundle(Pair, keep="latest")
    guesses = Output(Guess)

    async def run(self) -> None:
        """Guess."""
        total = 0.0
        async for pair in self.pairs:
            total += pair.seen.number + sum(reading.number for reading in pair.felt)
            await self.offload_for(self.config.latency, float, total)
            self.guesses.send(Guess(stamp=self.clock.now(), source=self.name, number=total))
            if self.config.end and self.clock.now() > self.config.end * 1e9:
                self.stop("enough was guessed")

    async def on_end(self) -> None:
        """Take time to end, in which more arrives."""
        await self.clock.sleep(0.05)

    async def on_shutdown(self) -> None:
        """Conclude."""
        self.conclude(
            self.name,
            {"ate_percent": 1.0, "events": len(self.pairs.statistics().__struct_fields__)},
        )


class Meddler(Node):
    """Has an influence on the flight."""

    orders = Output(Order)


def flight_file(folder: Path, text: str = "", run: str = "duration = '3s'") -> Path:
    """Write a file with a craft, its captain, and who watches them."""
    path = folder / "flight.toml"
    nodes = "".join(
        f"[[nodes]]\nname = '{name}'\ntype = '{__name__}:{type_}'\n"
        for name, type_ in (("before", "Guesser"), ("craft", "Craft"), ("captain", "Captain"))
    )
    guesser = f"[[nodes]]\nname = 'guesser'\ntype = '{__name__}:Guesser'\n"
    path.write_text(f"[run]\nname = 'flown'\nseed = 3\n{run}\n{nodes}{guesser}{text}\n")
    return path


def events_of(config: Config, **options: Any) -> tuple[Summary, list[str]]:
    """Run, and return the summary and a line for each event, in the order of sending."""
    lines: list[str] = []

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.name == "visnav.events":
                lines.append(record.getMessage())

    summary = execute(config, handlers=[Lines()], log_events=True, **options)
    return summary, lines


def flown(folder: Path, *overrides: str, text: str = "", run: str = "duration = '3s'") -> Config:
    """Return the settings of a file with a craft."""
    return load(flight_file(folder, text, run), [*overrides])
