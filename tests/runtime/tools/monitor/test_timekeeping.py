"""Time that stands, steps and goes at a speed."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable
from typing import Any

import pytest

from runtime.errors import CommandError
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.tools.monitor.timekeeping import Timekeeper

MS = 1_000_000


class Outside:
    """Calls functions on a lockstep loop from another thread, each when nothing more may happen."""

    def __init__(self, loop: LockstepLoop, calls: list[Callable[[], None]]) -> None:
        self._loop = loop
        self._calls = calls
        self._idle = threading.Event()
        self._wait = loop._jumping.wait
        loop._jumping.wait = self._sleep  # type: ignore[method-assign]
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _sleep(self, timeout: float | None) -> Any:
        if timeout is None:
            self._idle.set()
        return self._wait(timeout)

    def _run(self) -> None:
        for call in self._calls:
            assert self._idle.wait(10)
            self._idle.clear()
            self._loop.call_soon_threadsafe(call)


def test_time_stands_until_it_may_go_on() -> None:
    seen: list[tuple[str, int]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        clock = LockstepClock(loop)
        keeper = Timekeeper(clock)

        async def ticks() -> None:
            for n in range(100):
                await clock.sleep_until(n * 10 * MS)
                seen.append(("tick", clock.now() // MS))

        def see(what: str) -> Callable[[], None]:
            return lambda: seen.append((what, loop.now // MS))

        keeper.pause()
        assert keeper.paused
        Outside(
            loop,
            [
                see("paused"),
                lambda: keeper.step(0.025),
                see("stepped"),
                lambda: keeper.step(0.01),
                see("stepped"),
                lambda: keeper.step(None),
                see("stepped"),
                keeper.resume,
            ],
        )
        await ticks()

    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        runner.run(main())
    ticks = [time for what, time in seen if what == "tick"]
    assert ticks == [n * 10 for n in range(100)]  # nothing was lost
    others = [each for each in seen if each[0] != "tick" or each[1] <= 40]
    assert others[:2] == [("tick", 0), ("paused", 0)]
    assert [time for what, time in others if what == "stepped"] == [20, 30, 40]


@pytest.mark.parametrize("kind", ["timer", "work"])
def test_a_step_goes_to_the_next_thing_due_whatever_it_is(kind: str) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        clock = LockstepClock(loop)
        keeper = Timekeeper(clock)
        keeper.pause()
        work: concurrent.futures.Future[None] = concurrent.futures.Future()
        work.set_result(None)
        late = asyncio.create_task(clock.sleep(0.02))
        early = asyncio.create_task(
            asyncio.sleep(0.005) if kind == "timer" else clock.beside(work, 5 * MS)
        )
        at: list[tuple[int, bool]] = []
        Outside(
            loop,
            [
                lambda: keeper.step(None),
                lambda: at.append((loop.now // MS, early.done())),
                lambda: keeper.step(None),
                lambda: at.append((loop.now // MS, late.done())),
                keeper.resume,
            ],
        )
        await asyncio.gather(early, late, clock.sleep(0.03))
        assert at == [(5, True), (20, True)]

    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        runner.run(main())


def test_a_speed_holds_from_now_on_and_can_be_taken_back() -> None:
    loop = LockstepLoop(speed=2.0)
    try:
        keeper = Timekeeper(LockstepClock(loop))
        assert keeper.target_speed == 2.0
        loop.now = 1_000_000_000
        loop._wall_origin = 5.0
        keeper.pace(4.0)
        assert keeper.target_speed == 4.0
        assert loop._wall_origin is None  # or it would hurry to where it was going
        keeper.pace(None)
        assert keeper.target_speed is None
    finally:
        loop.close()


def test_time_that_is_common_to_several_processes_is_left_alone() -> None:
    class Others:
        def may_go(self, key: tuple[int, int, int]) -> bool:
            return True

    loop = LockstepLoop()
    try:
        loop.gate = Others()
        keeper = Timekeeper(LockstepClock(loop))
        with pytest.raises(CommandError, match="goes on in other processes"):
            keeper.pause()
        assert not keeper.paused
    finally:
        loop.close()
