"""Simulated time tied to real time by a speed, and what of the outside it notices meanwhile."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from typing import Any

import pytest

from runtime.time import lockstep
from runtime.time.clock import Tick, Ticker
from runtime.time.lockstep import LockstepLoop


class Wall:
    """Stands in for the module `time` and for the selector's wait."""

    def __init__(self) -> None:
        self.now = 500.0
        self.waits: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def wait(self, timeout: float | None) -> list[Any]:
        if timeout:
            self.waits.append(timeout)
            self.now += timeout
        return []


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_a_speed_sleeps_between_what_is_due(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = Wall()
    monkeypatch.setattr(lockstep, "time", wall)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        loop._jumping.wait = wall.wait  # type: ignore[method-assign]
        for _ in range(3):
            await asyncio.sleep(1)
        wall.now += 1.5 / speed  # something took long: the next two sleeps catch up
        await asyncio.sleep(1)
        await asyncio.sleep(1)

    with asyncio.Runner(loop_factory=lambda: LockstepLoop(speed)) as runner:
        runner.run(main())
        waits = wall.waits[:4]
    assert waits == pytest.approx([1 / speed, 1 / speed, 1 / speed, 0.5 / speed])


def test_a_real_wait_takes_at_least_its_time() -> None:
    async def main() -> None:
        await asyncio.sleep(1)

    begin = time.monotonic()
    # Real, for it is the selector's wait that is tested: one simulated second in 10 ms.
    with asyncio.Runner(loop_factory=lambda: LockstepLoop(100.0)) as runner:
        runner.run(main())
    assert time.monotonic() - begin >= 0.01


def test_without_a_speed_nothing_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = Wall()
    monkeypatch.setattr(lockstep, "time", wall)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        loop._jumping.wait = wall.wait  # type: ignore[method-assign]
        await asyncio.sleep(1e6)

    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        runner.run(main())
    assert wall.waits == []


def test_a_signal_is_noticed_while_time_runs_freely() -> None:
    async def main() -> int:
        loop, count = asyncio.get_running_loop(), 0
        noticed = asyncio.Event()
        loop.add_signal_handler(signal.SIGUSR1, noticed.set)
        os.kill(os.getpid(), signal.SIGUSR1)
        while not noticed.is_set() and count < 10_000:
            await asyncio.sleep(1)
            count += 1
        loop.remove_signal_handler(signal.SIGUSR1)
        return count

    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        assert runner.run(main()) <= 2 * lockstep._POLL_EVERY


def test_a_signal_is_noticed_while_nothing_but_ticks_happens() -> None:
    """Ticks run on the spot, without a turn of the loop between them."""
    count = 0

    def tick(at: Tick) -> None:
        nonlocal count
        count = at.index
        if count == 10:
            os.kill(os.getpid(), signal.SIGUSR1)
        ticker.stopped = count > 10_000

    ticker = Ticker("t", 1000, tick, lambda error: pytest.fail(str(error)))

    async def main() -> int:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        noticed = loop.create_future()
        loop.add_signal_handler(signal.SIGUSR1, noticed.set_result, None)
        loop.schedule.add(0, ticker)
        await noticed
        ticker.stopped = True
        loop.remove_signal_handler(signal.SIGUSR1)
        return count

    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        assert runner.run(main()) <= 2 * lockstep._POLL_EVERY
