"""Simulated time: it jumps, it is exact, and waits for work."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

import pytest

from runtime.testing import run_in_lockstep
from runtime.time.clock import SECOND, Once, Tick, Ticker
from runtime.time.lockstep import LockstepClock, LockstepLoop

R = TypeVar("R")
MS = 1_000_000


def clock_of_loop() -> tuple[LockstepLoop, LockstepClock]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, LockstepLoop)
    return loop, LockstepClock(loop)


def test_sleeps_time_outs_and_timers_jump() -> None:
    async def main() -> list[float]:
        loop, times = asyncio.get_running_loop(), list[float]()
        await asyncio.sleep(3600)
        times.append(loop.time())
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1800):
                await asyncio.Event().wait()
        times.append(loop.time())
        later = loop.create_future()
        loop.call_later(1800, later.set_result, None)
        await later
        return [*times, loop.time()]

    assert run_in_lockstep(main()) == [3600.0, 5400.0, 7200.0]


@pytest.mark.slow
def test_many_short_sleeps_do_not_drift() -> None:
    async def main() -> int:
        for _ in range(100_000):
            await asyncio.sleep(0.001)
        return clock_of_loop()[0].now

    assert run_in_lockstep(main()) == 100 * SECOND


@pytest.mark.parametrize("hz", [30, 400, 7])
def test_sleeps_and_ticks_agree_on_the_time_to_the_nanosecond(hz: int) -> None:
    async def main() -> list[int]:
        _, clock = clock_of_loop()
        ticks: list[int] = []
        clock.schedule.add(0, Ticker("t", hz, lambda _: ticks.append(clock.now()), lambda _: None))
        await asyncio.sleep(100)
        return ticks

    assert run_in_lockstep(main())[: 100 * hz] == [i * SECOND // hz for i in range(100 * hz)]


def test_timers_of_one_time_run_in_the_order_in_which_they_were_set() -> None:
    async def main() -> list[int]:
        loop, log = asyncio.get_running_loop(), list[int]()
        timers = [loop.call_at(1.0, log.append, i) for i in range(100)]
        for timer in timers[::3]:
            timer.cancel()
        await asyncio.sleep(2)
        return log

    assert run_in_lockstep(main()) == [i for i in range(100) if i % 3]


def test_at_one_time_timers_come_before_work_and_work_before_the_schedule() -> None:
    async def main() -> list[str]:
        loop, clock = clock_of_loop()
        log: list[str] = []

        async def work() -> None:
            await clock.beside(loop._default_executor.submit(int), 10 * MS)  # type: ignore[attr-defined]
            log.append("work")

        clock.schedule.add(10 * MS, Once(lambda: log.append("schedule")))
        task = asyncio.create_task(work())
        await asyncio.sleep(0)
        loop.call_later(0.01, log.append, "timer")
        await task
        await clock.sleep(0.01)
        return log

    assert run_in_lockstep(main()) == ["timer", "work", "schedule"]


def test_a_cancelled_timer_moves_no_time() -> None:
    """Someone outside then finds the time at which something last happened."""

    async def main() -> int:
        loop, clock = clock_of_loop()
        timer = loop.call_later(3600, lambda: None)
        clock.schedule.add(5 * MS, Once(timer.cancel))
        woken = loop.create_future()
        outside = threading.Timer(0.02, lambda: loop.call_soon_threadsafe(woken.set_result, None))
        outside.start()
        await woken
        outside.join()
        return loop.now

    assert run_in_lockstep(main()) == 5 * MS


def run_clock(main: Callable[[LockstepLoop, LockstepClock], Coroutine[Any, Any, R]]) -> R:
    async def prepared() -> R:
        return await main(*clock_of_loop())

    return run_in_lockstep(prepared())


def test_time_waits_at_the_due_time_of_slow_work_and_runs_freely_up_to_it() -> None:
    async def main(loop: LockstepLoop, clock: LockstepClock) -> list[int]:
        executor: Any = loop._default_executor  # type: ignore[attr-defined]
        go, seen = threading.Event(), list[int]()
        task = asyncio.create_task(clock.beside(executor.submit(go.wait, 10), 50 * MS))
        await clock.sleep(0.04)
        seen.append(clock.now())
        # The work goes on only when time stands at its due time, with a later timer waiting.
        clock.schedule.add(50 * MS - 1, Once(go.set))
        loop.call_later(3600, seen.append, -1)
        assert await task is True
        return [*seen, clock.now()]

    assert run_clock(main) == [40 * MS, 50 * MS]


def test_the_outside_is_served_while_time_waits_for_work() -> None:
    """Here the work itself waits for an answer of the loop's."""

    async def main(loop: LockstepLoop, clock: LockstepClock) -> tuple[bool, int]:
        answered = threading.Event()

        def ask() -> bool:
            # Real, for by then the loop is to have nothing left to do but to wait.
            time.sleep(0.02)
            loop.call_soon_threadsafe(answered.set)
            return answered.wait(5)

        executor: Any = loop._default_executor  # type: ignore[attr-defined]
        return await clock.beside(executor.submit(ask)), clock.now()

    assert run_clock(main) == (True, 0)


def test_threads_without_latency_freeze_time() -> None:
    async def main(loop: LockstepLoop, clock: LockstepClock) -> int:
        ticks: list[Tick] = []
        clock.schedule.add(1, Ticker("t", 1000, ticks.append, lambda _: None))
        await asyncio.to_thread(sum, range(100_000))
        await loop.run_in_executor(None, sum, range(100_000))
        assert ticks == []
        return clock.now()

    assert run_clock(main) == 0


def test_in_a_hurry_what_is_due_waits_for_no_slower_work() -> None:
    """As when a run is to end while a system outside is still waited for, for ever."""
    order: list[str] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        clock = LockstepClock(loop)

        async def wait(name: str, work: concurrent.futures.Future[None], latency: int) -> None:
            await clock.beside(work, latency)
            order.append(name)

        names = ("never", "one", "two", "later")
        works = {name: concurrent.futures.Future[None]() for name in names}
        tasks = [asyncio.create_task(wait(n, w, 5 * (n == "later"))) for n, w in works.items()]
        await asyncio.sleep(0)
        for name in reversed(names[1:]):
            works[name].set_result(None)
        loop.call_soon(clock.hurry)
        await asyncio.wait(tasks[1:3])
        assert order == ["one", "two"]
        assert loop.now == 0
        works["never"].set_result(None)
        await asyncio.wait(tasks)
        assert order == ["one", "two", "never", "later"]
        assert loop.now == 5

    run_in_lockstep(main())
