"""Cancelling a coroutine in every phase, the turn between a send and its task's next step too.

Between the two, the coroutine has gone on inside `offer`, but its task doesn't know yet.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from runtime.channels.streams import Stream
from tests.runtime.loops import Run, turns

Then = Callable[[list[str]], Awaitable[None]]


async def cancelled(then: Then, turns_before: int) -> list[str]:
    """Resume a reader that does `then`, cancel it some turns later, and return what happened."""
    stream, log = Stream[int]("s"), list[str]()

    async def reader() -> None:
        await stream.receive()
        log.append("resumed")
        try:
            await then(log)
        except asyncio.CancelledError:
            log.append("cancelled")
            raise

    task = asyncio.create_task(reader())
    await turns()
    stream.offer(1)
    await turns(turns_before)
    task.cancel()
    await asyncio.wait([task])
    log.append("task cancelled" if task.cancelled() else "task ended")
    return log


async def nothing(_: list[str]) -> None:
    pass


async def give_way(_: list[str]) -> None:
    await turns(1_000_000)


async def wait_for_ever(_: list[str]) -> None:
    await asyncio.get_running_loop().create_future()


async def sleep(_: list[str]) -> None:
    await asyncio.sleep(3600)


async def wait_for_a_stream(_: list[str]) -> None:
    await Stream[int]("other").receive()


@pytest.mark.parametrize("turns_before", [0, 1, 2, 3])
@pytest.mark.parametrize("then", [give_way, wait_for_ever, sleep, wait_for_a_stream])
def test_whatever_it_waits_for_a_resumed_coroutine_can_be_cancelled(
    ours: Run, then: Then, turns_before: int
) -> None:
    log = ours(cancelled(then, turns_before))
    assert log == ["resumed", "cancelled", "task cancelled"]


def test_one_that_has_ended_before_the_cancellation_keeps_its_result(ours: Run) -> None:
    assert ours(cancelled(nothing, 0)) == ["resumed", "task ended"]


def test_one_that_has_failed_before_the_cancellation_keeps_its_error(ours: Run) -> None:
    async def main() -> None:
        stream = Stream[int]("s")

        async def reader() -> float:
            return 1 / await stream.receive()

        task = asyncio.create_task(reader())
        await turns()
        stream.offer(0)
        task.cancel()
        with pytest.raises(ZeroDivisionError):
            await task

    ours(main())


@pytest.mark.parametrize("turns_before", [0, 1, 2, 3])
def test_a_task_that_it_waits_for_is_cancelled_and_ends_first(ours: Run, turns_before: int) -> None:
    """As with stock tasks: whoever awaits a task that cleans up is cancelled after that."""

    async def wait_for_a_task(log: list[str]) -> None:
        async def inner() -> None:
            try:
                await asyncio.sleep(3600)
            finally:
                await turns()
                log.append("inner cleaned up")

        task = asyncio.create_task(inner())
        task.add_done_callback(lambda t: log.append(f"inner cancelled: {t.cancelled()}"))
        await task

    log = ours(cancelled(wait_for_a_task, turns_before))
    assert log[1:3] == ["inner cleaned up", "inner cancelled: True"]
    assert log[3:] == ["cancelled", "task cancelled"]


def test_what_it_awaits_may_refuse_the_cancellation(ours: Run) -> None:
    """As with stock tasks: a task that ends well all the same gives its result."""

    async def main() -> str:
        stream = Stream[int]("s")

        async def stubborn() -> str:
            try:
                await asyncio.sleep(3600)
            except asyncio.CancelledError:
                return "result"
            return "?"

        async def reader() -> str:
            inner = asyncio.create_task(stubborn())
            await turns()
            await stream.receive()
            return await inner

        task = asyncio.create_task(reader())
        await turns(6)
        stream.offer(1)
        task.cancel()
        return await task

    assert ours(main()) == "result"


def test_a_coroutine_that_its_own_send_cancels_stops_at_its_next_wait(ours: Run) -> None:
    async def main() -> list[Any]:
        stream, log = Stream[int]("s"), list[Any]()

        async def reader() -> None:
            await stream.receive()
            task.cancel()
            log.append("goes on")
            await stream.receive()

        task = asyncio.create_task(reader())
        await turns()
        stream.offer(1)
        await asyncio.wait([task])
        stream.offer(2)
        return [*log, task.cancelled(), stream.receive_nowait()]

    assert ours(main()) == ["goes on", True, 2]


def test_a_cancellation_carries_its_message(run: Run) -> None:
    async def main() -> str:
        stream = Stream[int]("s")

        async def reader() -> str:
            try:
                await stream.receive()
            except asyncio.CancelledError as error:
                return str(error)
            return "?"

        task = asyncio.create_task(reader())
        await turns()
        task.cancel("enough")
        return await task

    assert run(main()) == "enough"


@pytest.mark.parametrize("turns_before", [0, 1, 2])
def test_uncancel_lets_a_coroutine_go_on(ours: Run, turns_before: int) -> None:
    async def go_on(log: list[str]) -> None:
        task = asyncio.current_task()
        assert task is not None
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            log.append(f"{task.cancelling()} {task.uncancel()}")
        await turns()

    assert ours(cancelled(go_on, turns_before)) == ["resumed", "1 0", "task ended"]
