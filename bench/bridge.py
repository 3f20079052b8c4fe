"""What the runtime adds to Zenoh between two processes: round trips and bursts, beside raw Zenoh.

Two nodes of one run in two processes, on the real clock, against two bare Zenoh sessions in the
same two processes. What is asked is a small event, or an image; the answer is always small. Blocks
of both are measured in turns, in an order that is drawn, so that whatever else the machine does
falls on both alike; a ratio is that of the two medians.
"""

from __future__ import annotations

import asyncio
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from bench.systems.zenoh_system import config, free_locator, publisher, subscribe
from events import Event, Image
from runtime import Input, Node, Output
from runtime.config.model import Config
from runtime.config.reading import parse
from runtime.run.execute import execute

BLOCK = 50
"""Round trips of one side before it may be the other's turn."""

WARM_UP = 50
IMAGES = {"512×512 rgb8": (512, 512, 3), "1080×1080 rgb8": (1080, 1080, 3)}


class BridgeRow(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of event.

    Attributes:
        case: What was asked.
        bytes: Of its payload.
        samples: Round trips of each side.
        ours_us: Median of ours, in microseconds.
        zenoh_us: Median of raw Zenoh's.
        ratio: Ours to Zenoh's.
        ours_p99_us: 99th percentile of ours.
        zenoh_p99_us: Of Zenoh's.
        ours_per_second: Events of a burst that came through, each second.
        zenoh_per_second: The same of raw Zenoh.
    """

    case: str
    bytes: int
    samples: int
    ours_us: float
    zenoh_us: float
    ratio: float
    ours_p99_us: float
    zenoh_p99_us: float
    ours_per_second: float
    zenoh_per_second: float


class Asked(Event):
    """A small question."""

    number: int
    answer: bool = True


class Answered(Event):
    """An answer to whatever was asked."""

    number: int


class Mirror(Node):
    """Answers each question and each image, in the other process."""

    questions = Input(Asked, bound=100_000)
    images = Input(Image, bound=1000)
    answers = Output(Answered)

    async def run(self) -> None:
        """Answer."""
        self.start(self._look())
        async for question in self.questions:
            if question.answer:
                self._answer(question.number)

    async def _look(self) -> None:
        async for image in self.images:
            if image.source == "asker":
                self._answer(0)

    def _answer(self, number: int) -> None:
        self.answers.send(Answered(stamp=self.clock.now(), source=self.name, number=number))


class Asker(Node):
    """Measures what it takes to be answered, in turns with raw Zenoh."""

    questions = Output(Asked)
    images = Output(Image)
    answers = Input(Answered)

    samples = 1000
    raw: Raw
    rows: list[BridgeRow]
    progress: Callable[[str], None]

    async def run(self) -> None:
        """Measure, and end the run."""
        cls = type(self)
        cls.rows = [await self._measure("small event", None)]
        for case, shape in IMAGES.items():
            cls.rows.append(await self._measure(case, shape))
        self.stop("measured")

    async def _measure(self, case: str, shape: tuple[int, ...] | None) -> BridgeRow:
        self.progress(case)
        data = None if shape is None else np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        samples = self.samples if data is None else max(self.samples // 4, BLOCK)
        ours: list[int] = []
        raw: list[int] = []
        sides = [True, False] * (-(-(samples + WARM_UP) // BLOCK))
        random.Random(0).shuffle(sides)
        for mine in sides:
            if mine:
                ours += [await self._round_trip(data) for _ in range(BLOCK)]
            else:
                raw += await asyncio.to_thread(self.raw.round_trips, data, BLOCK)
        burst = 200 if data is None else 20
        ours_burst = [await self._burst(data, burst) for _ in range(5)]
        raw_burst = [await asyncio.to_thread(self.raw.burst, data, burst) for _ in range(5)]
        middle, high = (
            [float(np.percentile(side[WARM_UP:], q)) / 1e3 for side in (ours, raw)]
            for q in (50, 99)
        )
        return BridgeRow(
            case=case,
            bytes=64 if data is None else data.nbytes,
            samples=samples,
            ours_us=middle[0],
            zenoh_us=middle[1],
            ratio=middle[0] / middle[1],
            ours_p99_us=high[0],
            zenoh_p99_us=high[1],
            ours_per_second=float(np.median(ours_burst)),
            zenoh_per_second=float(np.median(raw_burst)),
        )

    async def _round_trip(self, data: npt.NDArray[np.uint8] | None) -> int:
        begin = time.perf_counter_ns()
        self._ask(data)
        await anext(self.answers)
        return time.perf_counter_ns() - begin

    async def _burst(self, data: npt.NDArray[np.uint8] | None, count: int) -> float:
        """Return events a second: many questions, of which only the last is answered."""
        begin = time.perf_counter_ns()
        for number in range(count):
            self._ask(data, answer=number == count - 1)
        for _ in range(1 if data is None else count):
            await anext(self.answers)
        return count * 1e9 / (time.perf_counter_ns() - begin)

    def _ask(self, data: npt.NDArray[np.uint8] | None, *, answer: bool = True) -> None:
        now = self.clock.now()
        if data is None:
            self.questions.send(Asked(stamp=now, source=self.name, number=0, answer=answer))
        else:
            self.images.send(Image(stamp=now, source=self.name, frame_id="f", data=data))


class Raw:
    """The asking end of two bare sessions."""

    def __init__(self, locator: str) -> None:
        import zenoh

        self._session = zenoh.open(config(zenoh, listen=locator))
        self._put = publisher(zenoh, self._session, "asked").put
        self._answered = threading.Semaphore(0)
        self._kept = subscribe(zenoh, self._session, "answered", lambda _: self._answered.release())

    def round_trips(self, data: npt.NDArray[np.uint8] | None, count: int) -> list[int]:
        """Return the nanoseconds of each."""
        taken = []
        for _ in range(count):
            begin = time.perf_counter_ns()
            self._ask(data)
            self._answered.acquire()
            taken.append(time.perf_counter_ns() - begin)
        return taken

    def burst(self, data: npt.NDArray[np.uint8] | None, count: int) -> float:
        """Return events a second."""
        begin = time.perf_counter_ns()
        for _ in range(count):
            self._ask(data)
        for _ in range(count):
            self._answered.acquire()
        return count * 1e9 / (time.perf_counter_ns() - begin)

    def close(self) -> None:
        """End the session."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _ask(self, data: npt.NDArray[np.uint8] | None) -> None:
        # Zenoh takes no arrays; their bytes are new each time, as an image is.
        self._put(b"x" * 64 if data is None else data.tobytes())


def measure(
    samples: int = 1000, progress: Callable[[str], None] = lambda _: None
) -> list[BridgeRow]:
    """Measure small events and images.

    Args:
        samples: Round trips with small events on each side; a quarter with images.
        progress: Called with what is measured.
    """
    meet, locator = free_locator(), free_locator()
    Asker.samples, Asker.progress, Asker.rows = samples, staticmethod(progress), []
    with _other_process(meet, locator):
        Asker.raw = Raw(locator)
        try:
            execute(_config(meet), only=["asker"])
        finally:
            Asker.raw.close()
    return Asker.rows


def mirror(meet: str, locator: str) -> None:
    """Be the other process: a node that answers, and a bare session that does."""
    import zenoh

    with zenoh.open(config(zenoh, connect=locator)) as session:
        answer = publisher(zenoh, session, "answered").put

        def asked(sample: Any) -> None:
            np.frombuffer(sample.payload.to_bytes(), np.uint8)
            answer(b"x" * 64)

        _kept = subscribe(zenoh, session, "asked", asked)
        execute(_config(meet), only=["mirror"])


def _config(meet: str) -> Config:
    nodes = [{"name": n, "type": f"bench.bridge:{n.title()}"} for n in ("asker", "mirror")]
    run = {"name": "bench-bridge", "clock": "real", "stall": 0, "log": "error"}
    return parse({"run": run, "network": {"meet": meet}, "nodes": nodes}, "bench bridge")


@contextmanager
def _other_process(meet: str, locator: str) -> Iterator[None]:
    code = f"from bench.bridge import mirror; mirror({meet!r}, {locator!r})"
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        yield
        process.wait(10)
    finally:
        process.kill()
        process.wait()
