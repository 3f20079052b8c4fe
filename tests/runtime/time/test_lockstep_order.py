"""Nothing outside changes the order of things: the same program, the same events."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import pytest

from runtime.channels.streams import Stream
from runtime.testing import run_in_lockstep
from runtime.time.clock import Clock, Tick, Ticker
from runtime.time.lockstep import LockstepClock, LockstepLoop

R = TypeVar("R")
MS = 1_000_000


def clock_of_loop() -> tuple[LockstepLoop, LockstepClock]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, LockstepLoop)
    return loop, LockstepClock(loop)


class Story:
    """A program with all there is: ticks, sleeps, time-outs, streams and work beside the loop."""

    def __init__(self, clock: Clock, seed: int) -> None:
        self.clock = clock
        self.random = random.Random(seed)
        self.log: list[str] = []
        self.streams = [Stream[int](str(i)) for i in range(6)]

    def note(self, what: str) -> None:
        self.log.append(f"{self.clock.now()} {what}")

    def tick(self, tick: Tick) -> None:
        self.note(f"tick {tick.index}")
        for stream in self.random.sample(self.streams, 3):
            stream.offer(tick.index)

    async def read(self, number: int) -> None:
        while True:
            try:
                async with asyncio.timeout(0.02):
                    event = await self.streams[number].receive()
                    self.note(f"reader {number} has {event}")
                    if event % 3 == 0:
                        await asyncio.sleep(0.01)
            except TimeoutError:
                self.note(f"reader {number} is late")

    async def work(self, number: int) -> None:
        while True:
            latency = self.random.choice([0, 5, 10]) * MS
            await asyncio.to_thread(int)
            executor: Any = asyncio.get_running_loop()._default_executor  # type: ignore[attr-defined]
            await self.clock.beside(executor.submit(int), latency)
            self.note(f"work {number}")
            await self.clock.sleep(0.01)

    async def tell(self) -> list[str]:
        ticker = Ticker("tick", 100, self.tick, lambda e: pytest.fail(str(e)))
        self.clock.schedule.add(0, ticker)
        tasks = [asyncio.create_task(self.read(i)) for i in range(6)]
        tasks += [asyncio.create_task(self.work(i)) for i in range(2)]
        await asyncio.sleep(0.5)
        ticker.stopped = True
        for task in tasks:
            task.cancel()
        return self.log


def told(seed: int, around: Callable[[LockstepLoop], None] = lambda _: None) -> list[str]:
    async def main() -> list[str]:
        loop, clock = clock_of_loop()
        around(loop)
        return await Story(clock, seed).tell()

    return run_in_lockstep(main())


def test_a_noisy_thread_changes_nothing() -> None:
    """It wakes the loop at random moments, again and again."""
    quiet = told(seed=1)
    assert len(quiet) > 300
    for _ in range(10):
        over = threading.Event()

        def disturb(loop: LockstepLoop, over: threading.Event = over) -> None:
            def noise() -> None:
                while not over.wait(random.random() * 2e-5):
                    loop._wake_up()

            threading.Thread(target=noise, daemon=True).start()

        try:
            assert told(1, disturb) == quiet
        finally:
            over.set()


@pytest.mark.parametrize("seed", range(10))
def test_wake_ups_between_any_two_jumps_change_nothing(seed: int) -> None:
    """As a thread might, but at moments that a seed picks, so that failures come again."""
    quiet = told(seed)
    chance = random.Random(seed)

    def disturb(loop: LockstepLoop) -> None:
        run_first = loop.schedule.run_first

        def run_and_wake(now: int) -> None:
            run_first(now)
            if chance.random() < 0.5:
                loop._wake_up()

        loop.schedule.run_first = run_and_wake  # type: ignore[method-assign]

    assert told(seed, disturb) == quiet
