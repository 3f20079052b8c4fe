"""Time that stands, steps and goes at a speed, and what happens in it all the same."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import CommandError
from runtime.testing import run_in_lockstep
from runtime.time.clock import Once, RealClock, Ticker
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.time.stepping import Stepping

MS = 1_000_000


class Outside:
    """Calls functions on a lockstep loop from another thread, each when nothing more may happen."""

    def __init__(self, loop: LockstepLoop, calls: list[Callable[[], object]]) -> None:
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


def running_loop() -> tuple[LockstepLoop, LockstepClock]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, LockstepLoop)
    return loop, LockstepClock(loop)


def finished() -> concurrent.futures.Future[None]:
    work: concurrent.futures.Future[None] = concurrent.futures.Future()
    work.set_result(None)
    return work


def test_time_stands_until_it_may_go_on() -> None:
    seen: list[tuple[str, int]] = []

    async def main() -> None:
        loop, clock = running_loop()
        stepping = Stepping(clock)

        async def ticks() -> None:
            for n in range(100):
                await clock.sleep_until(n * 10 * MS)
                seen.append(("tick", clock.now() // MS))

        def see(what: str) -> Callable[[], None]:
            return lambda: seen.append((what, loop.now // MS))

        stepping.pause()
        assert stepping.state == "paused"
        Outside(
            loop,
            [
                see("paused"),
                lambda: stepping.step(25 * MS),
                see("stepped"),
                lambda: stepping.step(10 * MS),
                see("stepped"),
                stepping.step,
                see("stepped"),
                stepping.resume,
            ],
        )
        await ticks()

    run_in_lockstep(main())
    ticks = [time for what, time in seen if what == "tick"]
    assert ticks == [n * 10 for n in range(100)]  # nothing was lost
    others = [row for row in seen if row[0] != "tick" or row[1] <= 40]
    assert others[:2] == [("tick", 0), ("paused", 0)]
    assert [time for what, time in others if what == "stepped"] == [25, 35, 40]


@pytest.mark.parametrize("kind", ["timer", "work"])
def test_a_step_goes_to_the_next_thing_due_whatever_it_is(kind: str) -> None:
    async def main() -> None:
        loop, clock = running_loop()
        stepping = Stepping(clock)
        stepping.pause()
        late = asyncio.create_task(clock.sleep(0.02))
        early = asyncio.create_task(
            asyncio.sleep(0.005) if kind == "timer" else clock.beside(finished(), 5 * MS)
        )
        at: list[tuple[int, bool]] = []
        Outside(
            loop,
            [
                stepping.step,
                lambda: at.append((loop.now // MS, early.done())),
                stepping.step,
                lambda: at.append((loop.now // MS, late.done())),
                stepping.resume,
            ],
        )
        await asyncio.gather(early, late, clock.sleep(0.03))
        assert at == [(5, True), (20, True)]

    run_in_lockstep(main())


def test_all_that_is_due_when_time_comes_to_stand_is_done_and_nothing_after() -> None:
    async def main() -> list[str]:
        loop, clock = running_loop()
        stepping, done = Stepping(clock), list[str]()
        stepping.pause()

        async def at(ms: int, what: str, waits: Any) -> None:
            await waits
            done.append(f"{what} at {ms}")
            await asyncio.sleep(0)
            done.append(f"and after {what}")

        tasks = []
        for ms in (10, 11):
            clock.schedule.add(
                ms * MS, Ticker("t", 0.001, lambda _: done.append("tick"), lambda _: None)
            )
            waits = {
                "timer": asyncio.sleep(ms / 1000),
                "sleep": clock.sleep(ms / 1000),
                "work": clock.beside(finished(), ms * MS),
            }
            tasks += [asyncio.create_task(at(ms, *arguments)) for arguments in waits.items()]
        await asyncio.sleep(0)
        assert await stepping.step(10 * MS) == 10 * MS
        assert (loop.now, stepping.state) == (10 * MS, "paused")
        results = list(done)
        stepping.resume()
        await asyncio.gather(*tasks)
        assert len(done) == 2 * len(results)
        return results

    words = ["timer", "work", "sleep"]  # timers first, then work, then the schedule in its order
    assert [line for line in run_in_lockstep(main()) if line.endswith(" at 10")] == [
        f"{word} at 10" for word in words
    ]


def test_whoever_waits_until_time_stands_finds_all_that_is_due_done() -> None:
    async def main() -> None:
        loop, clock = running_loop()
        stepping = Stepping(clock)
        assert await stepping.stands() == 0  # at once: it is not to stand
        await clock.sleep(0.01)
        done: list[str] = []
        for name in "abc":  # due at the instant at which time is paused
            loop.schedule.add(20 * MS, Once(lambda name=name: done.append(name)))  # type: ignore[misc]
        loop.schedule.add(20 * MS + 1, Once(lambda: done.append("later")))
        await clock.sleep_until(20 * MS)
        stepping.pause()
        await stepping.stands()
        assert (done, loop.now, stepping.state) == (["a", "b", "c"], 20 * MS, "paused")
        stepping.resume()
        await clock.sleep(0.001)
        assert done == ["a", "b", "c", "later"]

    run_in_lockstep(main())


def test_a_step_goes_exactly_as_far_although_nothing_is_due_there_or_ever() -> None:
    async def main() -> None:
        loop, clock = running_loop()
        stepping = Stepping(clock)
        assert await stepping.step(3) == 3  # of a run that was not paused, too
        assert await stepping.step(5 * MS) == 5 * MS
        assert loop.now == 5 * MS + 3

    run_in_lockstep(main())


def test_a_step_that_is_cut_short_says_how_far_it_went() -> None:
    async def main() -> list[int]:
        loop, clock = running_loop()
        stepping, over = Stepping(clock), False
        stepping = Stepping(clock, lambda: over)
        results = []
        for end in (stepping.pause, stepping.resume):
            loop.call_at((loop.now + 3 * MS) / 1e9, end)
            results.append(await stepping.step(10 * MS))
        step = stepping.step(10 * MS)
        await clock.sleep(0.004)
        over = True
        results.append(await step)
        assert stepping.state == "running"  # what ends cannot be paused
        return results

    assert run_in_lockstep(main()) == [3 * MS, 3 * MS, 4 * MS]


@pytest.mark.slow
@given(
    st.lists(
        st.sampled_from([1, 7, 2_500, MS, 13 * MS, None, "pause", "resume", "wait"]), max_size=12
    )
)
def test_whatever_is_done_to_time_the_same_things_happen_at_the_same_times(acts: list[Any]) -> None:
    def run(acts: list[Any]) -> list[tuple[str, int]]:
        seen: list[tuple[str, int]] = []

        async def main() -> None:
            loop, clock = running_loop()
            stepping = Stepping(clock)

            def see(what: str) -> None:
                seen.append((what, loop.now))

            clock.schedule.add(0, Ticker("t", 700, lambda _: see("tick"), lambda _: None))
            loop.call_at(0.004, see, "timer")

            async def work(n: int) -> None:
                with concurrent.futures.ThreadPoolExecutor(1) as beside:
                    for _ in range(3):
                        await clock.beside(beside.submit(lambda: None), n * MS // 3)
                        see(f"work {n}")

            async def control() -> None:
                for act in acts:
                    if act == "pause":
                        stepping.pause()
                        assert stepping.state == "paused"
                    elif act == "resume":
                        stepping.resume()
                        assert stepping.state == "running"
                    elif act == "wait":
                        if stepping.state == "running":
                            await clock.sleep(0.0021)
                    else:
                        before = loop.now
                        gone = await stepping.step(act)
                        assert gone == loop.now - before
                        assert act in (None, gone)
                        assert stepping.state == "paused"
                stepping.resume()

            tasks = [asyncio.create_task(work(n)) for n in (4, 11)]
            await control()
            await asyncio.gather(*tasks)
            await clock.sleep_until(200 * MS)

        run_in_lockstep(main())
        return seen

    assert run(acts) == run([])


def test_a_speed_holds_from_now_on_and_can_be_taken_back() -> None:
    loop = LockstepLoop(speed=2.0)
    try:
        stepping = Stepping(LockstepClock(loop))
        assert stepping.target_speed == 2.0
        loop.now = 1_000_000_000
        loop._wall_origin = 5.0
        stepping.pace(4.0)
        assert stepping.target_speed == 4.0
        assert loop._wall_origin is None  # or it would hurry to where it was going
        stepping.pace(None)
        assert stepping.target_speed is None
    finally:
        loop.close()


def test_time_that_is_real_or_common_to_several_processes_is_left_alone() -> None:
    class Others:
        def may_go(self, key: tuple[int, int, int]) -> bool:
            return True

    loop = LockstepLoop()
    try:
        loop.gate = Others()
        common = Stepping(LockstepClock(loop))
        real = Stepping(RealClock(loop))
        for stepping, why in ((common, "goes on in other processes"), (real, "in real time")):
            for act in (stepping.pause, stepping.resume, stepping.step):
                with pytest.raises(CommandError, match=why):
                    act()
            assert stepping.state == "running"
    finally:
        loop.close()


@pytest.mark.parametrize("ns", [0, -1])
def test_a_step_goes_forward(ns: int) -> None:
    loop = LockstepLoop()
    try:
        with pytest.raises(ValueError, match="expected a step of 1 ns or more"):
            Stepping(LockstepClock(loop)).step(ns)
    finally:
        loop.close()


def test_real_seconds_are_not_counted_while_time_stands() -> None:
    """So a system outside is not given up for a pause, however long."""
    wall = [100.0]

    async def main() -> None:
        loop, clock = running_loop()
        stepping = Stepping(clock, wall=lambda: wall[0])
        seconds: list[float] = []

        def note(later: float) -> None:
            wall[0] += later
            seconds.append(stepping.real_seconds())

        def then(call: Callable[[], object]) -> Callable[[], None]:
            def noted() -> None:
                note(50.0)
                call()
                note(1.0)

            return noted

        Outside(loop, [then(lambda: stepping.step(5 * MS)), then(stepping.resume)])
        note(1.0)
        stepping.pause()
        note(1.0)  # it is still on its way to where it stands
        await clock.sleep(0.01)
        assert seconds == [101.0, 102.0, 102.0, 103.0, 103.0, 104.0]

    run_in_lockstep(main())
