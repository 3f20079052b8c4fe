"""What every clock does with work done beside it, in time and late."""

from __future__ import annotations

import asyncio
import concurrent.futures

import pytest

from runtime.time.clock import SECOND, Clock, Once
from tests.runtime.walls import RunClock

Work = concurrent.futures.Future[str]

MS = 1_000_000


def done(result: str) -> Work:
    work = Work()
    work.set_result(result)
    return work


def test_work_without_latency_comes_when_it_is_done(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> tuple[str, int]:
        return await clock.beside(done("result")), clock.now()

    assert run_clock(main) == ("result", 0)


def test_work_with_latency_comes_when_it_is_due(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> tuple[str, int]:
        await clock.sleep(1)
        return await clock.beside(done("result"), 80 * MS), clock.now()

    assert run_clock(main) == ("result", SECOND + 80 * MS)


def test_time_runs_on_while_work_is_under_way(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> list[int]:
        work = asyncio.create_task(clock.beside(done("result"), 80 * MS))
        await clock.sleep(0.05)
        before = clock.now()
        assert not work.done()
        await work
        return [before, clock.now()]

    assert run_clock(main) == [50 * MS, 80 * MS]


def test_late_work_is_waited_for(run_clock: RunClock) -> None:
    """In lockstep its result still comes when it was due; in real time it cannot."""

    async def main(clock: Clock) -> tuple[str, bool, int]:
        work = Work()
        if clock.kind == "lockstep":
            other = concurrent.futures.ThreadPoolExecutor(1)
            other.submit(work.set_result, "result")
        else:
            clock.schedule.add(300 * MS, Once(lambda: work.set_result("result")))
        result = await clock.beside(work, 80 * MS)
        return result, clock.kind == "lockstep", clock.now()

    result, lockstep, now = run_clock(main)
    assert (result, now) == ("result", 80 * MS if lockstep else 300 * MS)


@pytest.mark.parametrize("latency", [0, 80 * MS])
def test_an_error_in_work_reaches_whoever_awaits_it(run_clock: RunClock, latency: int) -> None:
    async def main(clock: Clock) -> None:
        work = Work()
        work.set_exception(ValueError("broken"))
        await clock.beside(work, latency)

    with pytest.raises(ValueError, match="broken"):
        run_clock(main)


def test_work_that_was_cancelled_cancels_whoever_awaits_it(run_clock: RunClock) -> None:
    async def main(clock: Clock) -> bool:
        work = Work()
        work.cancel()
        task = asyncio.create_task(clock.beside(work))
        await asyncio.wait([task])
        return task.cancelled()

    assert run_clock(main)


def test_whoever_stops_waiting_for_work_is_let_go_at_once(run_clock: RunClock) -> None:
    """Work that never ends then holds nobody up: time goes on past its due time."""

    async def main(clock: Clock) -> list[int]:
        task = asyncio.create_task(clock.beside(Work(), 80 * MS))
        await clock.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])
        at = clock.now()
        await clock.sleep(1)
        return [at, clock.now()]

    assert run_clock(main) == [10 * MS, SECOND + 10 * MS]
