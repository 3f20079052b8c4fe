"""Limits in real time: they hold on a simulated clock, and are no more than limits."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest

from runtime.time import real_time
from runtime.time.real_time import real_time_limit
from tests.runtime.loops import Run, turns

# Real, here and below, for it is real time that is limited; short enough to wait for.
SOON = 0.005
LATE = 60.0


def current() -> asyncio.Task[object]:
    task = asyncio.current_task()
    assert task is not None
    return task


def test_a_limit_expires_where_nothing_else_happens(run: Run) -> None:
    async def main() -> int:
        with pytest.raises(TimeoutError):
            async with real_time_limit(SOON):
                await asyncio.Event().wait()
        return current().cancelling()

    assert run(main()) == 0


def test_simulated_time_may_jump_far_within_a_limit() -> None:
    async def main() -> float:
        async with real_time_limit(LATE):
            await asyncio.sleep(1e6)
        return asyncio.get_running_loop().time()

    assert Run("lockstep", ours=True)(main()) == 1e6


def test_a_limit_has_no_effect_after_it_was_left(run: Run) -> None:
    async def main() -> bool:
        async with real_time_limit(SOON):
            pass
        # Longer than the limit, to see that it does not come after all.
        await asyncio.to_thread(threading.Event().wait, 3 * SOON)
        await asyncio.sleep(0)
        return current().cancelling() == 0

    assert run(main())


def test_a_limit_that_rings_while_it_is_being_left_comes_too_late(run: Run) -> None:
    async def main() -> int:
        async with real_time_limit(SOON):
            # Real, and with the loop standing still: the limit rings, but nobody hears it yet.
            time.sleep(3 * SOON)  # noqa: ASYNC251
        await turns()
        return current().cancelling()

    assert run(main()) == 0


def test_a_limit_that_was_left_keeps_no_thread() -> None:
    async def main() -> None:
        async with real_time_limit(LATE):
            pass

    Run("asyncio", ours=True)(main())
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    for timer in timers:
        timer.join(LATE / 10)
    assert not any(timer.is_alive() for timer in timers)


def test_a_cancellation_from_elsewhere_is_not_taken_for_the_limit(run: Run) -> None:
    async def main() -> bool:
        async def limited() -> None:
            async with real_time_limit(LATE):
                await asyncio.Event().wait()

        task = asyncio.create_task(limited())
        await asyncio.sleep(0)
        task.cancel()
        await asyncio.wait([task])
        return task.cancelled()

    assert run(main())


def test_a_cancellation_at_the_moment_of_the_limit_is_not_swallowed(run: Run) -> None:
    async def main() -> tuple[bool, int]:
        async def limited() -> None:
            async with real_time_limit(SOON):
                try:
                    await asyncio.Event().wait()
                finally:
                    task.cancel()

        task = asyncio.create_task(limited())
        await asyncio.wait([task])
        return task.cancelled(), task.cancelling()

    cancelled, cancelling = run(main())
    assert cancelled
    assert cancelling == 1


@pytest.mark.parametrize(("starved", "seconds"), [(0.0, 60), (0.9, 591), (1.0, None)])
def test_what_a_busy_machine_takes_is_no_part_of_a_limit(
    starved: float, seconds: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that waits for a processor for nine of ten seconds has nine times as many more."""
    now = 0.0

    @contextlib.asynccontextmanager
    async def passes(seconds: float) -> AsyncIterator[None]:
        nonlocal now
        now += seconds
        if now > 1000:
            task.set_result(None)
        raise TimeoutError
        yield

    monkeypatch.setattr(real_time, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(real_time, "real_time_limit", passes)
    monkeypatch.setattr(real_time, "waits_of", lambda _: {"1": now * starved * 1e9, "2": 0})
    loop = asyncio.new_event_loop()
    task: Any = loop.create_future()
    late = loop.run_until_complete(real_time.ended([task], 60.0))
    loop.close()
    assert late == ([] if seconds is None else [task])
    assert now == pytest.approx(seconds or 1001)


def test_starvation_is_that_of_the_thread_that_waits_longest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now: tuple[float, dict[str, float]] = 0, {"a": 7e9}
    monkeypatch.setattr(real_time, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(real_time, "waits_of", lambda _: now[1])
    starvation = real_time.Starvation()
    assert starvation.look() == 0
    now = 10, {"a": 9e9, "b": 3e9}
    assert starvation.look() == 3
    now = 11, {"b": 99e9}
    assert starvation.look() == 4
    now = 12, {}
    assert starvation.look() == 4


def test_the_kernel_says_how_long_threads_wait() -> None:
    assert min(real_time.waits_of(os.getpid()).values(), default=0) >= 0
    assert real_time.waits_of(-1) == {}


def test_a_limit_within_a_limit_expires_alone(run: Run) -> None:
    async def main() -> str:
        async with real_time_limit(LATE):
            try:
                async with real_time_limit(SOON):
                    await asyncio.Event().wait()
            except TimeoutError:
                await asyncio.sleep(0)
                return "inner"
        return "?"

    assert run(main()) == "inner"


def test_a_limit_works_in_the_cleaning_up_of_a_cancelled_task(run: Run) -> None:
    async def main() -> str:
        async def clean_up() -> str:
            try:
                await asyncio.Event().wait()
            finally:
                try:
                    async with real_time_limit(SOON):
                        await asyncio.Event().wait()
                except TimeoutError:
                    return "limited"  # the test is about what was raised
            return "?"

        task = asyncio.create_task(clean_up())
        await asyncio.sleep(0)
        task.cancel()
        return await task

    assert run(main()) == "limited"


def test_an_expired_limit_leaves_no_cancellation_behind_when_something_else_is_raised(
    run: Run,
) -> None:
    async def fail() -> None:
        async with real_time_limit(SOON):
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                raise ValueError("while cleaning up") from None

    async def main() -> int:
        with pytest.raises(ValueError, match="while cleaning up"):
            await fail()
        return current().cancelling()

    assert run(main()) == 0


def test_errors_pass_through(run: Run) -> None:
    async def main() -> None:
        async with real_time_limit(LATE):
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        run(main())
