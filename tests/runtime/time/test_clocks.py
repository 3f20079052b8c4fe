"""What every clock does: telling the time, sleeping, ticking."""

from __future__ import annotations

import asyncio

from runtime.time.clock import SECOND, Clock, Tick, Ticker
from tests.runtime.loops import turns
from tests.runtime.walls import RunClock

MS = 1_000_000


def test_a_sleep_takes_its_time_and_no_more(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> list[int]:
        await clock.sleep(0.25)
        first = clock.now()
        await clock.sleep_until(first + 3)
        return [first, clock.now()]

    first, second = run_clock(main)
    assert first == 250 * MS
    assert second in {first + 3, first + 4}  # at double speed, wall time has steps of 2 ns


def test_sleeping_until_the_past_gives_way_once(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> tuple[int, list[str]]:
        await clock.sleep(1)
        log: list[str] = []
        asyncio.get_running_loop().call_soon(log.append, "other")
        await clock.sleep_until(SECOND // 2)
        await clock.sleep_until(SECOND)
        await clock.sleep(-1)
        return clock.now(), log

    assert run_clock(main) == (SECOND, ["other"])


def test_sleepers_wake_in_the_order_of_their_times_and_then_of_asking(
    run_clock: RunClock,
) -> None:
    async def main(clock: Clock) -> list[str]:
        log: list[str] = []

        async def sleeper(name: str, seconds: float) -> None:
            await clock.sleep(seconds)
            log.append(f"{name} {clock.now() // MS}")

        async with asyncio.TaskGroup() as group:
            for name, seconds in (("b", 0.02), ("c", 0.02), ("a", 0.01), ("d", 0.02)):
                group.create_task(sleeper(name, seconds))
        return log

    assert run_clock(main) == ["a 10", "b 20", "c 20", "d 20"]


def test_a_cancelled_sleep_ends_at_once_and_disturbs_nobody(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> tuple[int, int]:
        sleeper = asyncio.create_task(clock.sleep(1))
        await turns()
        sleeper.cancel()
        await asyncio.wait([sleeper])
        assert sleeper.cancelled()
        at = clock.now()
        await clock.sleep(2)
        return at, clock.now()

    assert run_clock(main) == (0, 2 * SECOND)


def test_ticks_come_in_order_and_on_time(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> list[tuple[str, int, int]]:
        log: list[tuple[str, int, int]] = []
        for name, hz in (("slow", 50.0), ("fast", 100.0)):

            def note(tick: Tick, name: str = name) -> None:
                log.append((name, tick.stamp // MS, tick.late))

            clock.schedule.add(clock.now(), Ticker(name, hz, note, lambda _: None))
        await clock.sleep(0.025)
        return list(log)

    expected = [("slow", 0), ("fast", 0), ("fast", 10), ("slow", 20), ("fast", 20)]
    assert run_clock(main) == [(name, stamp, 0) for name, stamp in expected]
