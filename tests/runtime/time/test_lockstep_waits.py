"""The cause for which simulated time waits, and time taken over from another process."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from runtime.time import lockstep
from runtime.time.clock import SECOND
from runtime.time.lockstep import LockstepLoop

Body = Callable[[LockstepLoop], Coroutine[Any, Any, None]]


def run(body: Body, speed: float | None = None) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        await body(loop)

    with asyncio.Runner(loop_factory=lambda: LockstepLoop(speed)) as runner:
        runner.run(main())


def test_time_waits_for_nothing_if_nothing_is_due() -> None:
    async def body(loop: LockstepLoop) -> None:
        assert loop.waits_for() == "nothing"

    run(body)


@pytest.mark.parametrize(("speed", "cause"), [(None, None), (2.0, "pace")])
def test_a_timer_waits_for_the_pace_if_there_is_one(speed: float | None, cause: str | None) -> None:
    async def body(loop: LockstepLoop) -> None:
        timers = [loop.call_at(at, lambda: None) for at in (5.0, 7.0)]
        assert loop.waits_for() == cause
        for timer in timers:
            timer.cancel()

    run(body, speed)


def test_a_ready_callback_is_no_waiting() -> None:
    async def body(loop: LockstepLoop) -> None:
        loop.call_soon(lambda: None)
        assert loop.waits_for() is None

    run(body, 2.0)


def test_time_waits_for_the_work_that_is_due_first_until_it_is_done() -> None:
    async def body(loop: LockstepLoop) -> None:
        work: concurrent.futures.Future[int] = concurrent.futures.Future()
        future = loop.hold(work, SECOND)
        earlier = loop.call_at(0.5, lambda: None)
        later = loop.call_at(2.0, lambda: None)
        assert loop.waits_for() is None  # the earlier timer is due first
        earlier.cancel()
        loop._scheduled.remove(earlier)  # type: ignore[attr-defined]
        assert loop.waits_for() is future
        work.set_result(3)
        assert loop.waits_for() is None
        later.cancel()
        assert await future == 3

    run(body)


def test_time_from_another_process_never_goes_back() -> None:
    async def body(loop: LockstepLoop) -> None:
        loop.move(4 * SECOND, (10, 20))
        assert loop.time() == 4.0
        loop.move(3 * SECOND, (11, 21))
        assert loop.time() == 4.0

    run(body)


def test_pace_counts_from_the_time_at_which_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    class Wall:
        now = 500.0

        def monotonic(self) -> float:
            return self.now

        def wait(self, timeout: float | None) -> list[Any]:
            waits.append(timeout or 0.0)
            self.now += timeout or 0.0
            return []

    wall = Wall()
    monkeypatch.setattr(lockstep, "time", wall)

    async def body(loop: LockstepLoop) -> None:
        loop._jumping.wait = wall.wait  # type: ignore[method-assign]
        loop.move(6 * SECOND, (0, 0))
        await asyncio.sleep(1)
        assert [wait for wait in waits if wait] == pytest.approx([0.25])

    run(body, 4.0)
