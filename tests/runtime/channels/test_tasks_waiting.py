"""A coroutine resumed inside `offer` may then wait for anything at all."""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from runtime.channels.streams import Stream
from tests.runtime.loops import Run, turns

who = contextvars.ContextVar("who", default="nobody")


async def parked(
    stream: Stream[int], then: Callable[[int], Awaitable[Any]], name: str | None = None
) -> asyncio.Task[Any]:
    """Return a task that waits for an event and then does something with it."""

    async def reader() -> Any:
        return await then(await stream.receive())

    task = asyncio.create_task(reader(), name=name)
    await turns()
    return task


async def sleep(_: int) -> str:
    await asyncio.sleep(1e-6)  # a timer, and not the ready queue, is to end it
    return "done"


async def wait_for_a_future(_: int) -> str:
    loop = asyncio.get_running_loop()
    future = loop.create_future()
    loop.call_soon(future.set_result, "done")
    return str(await future)


async def wait_for_a_task(_: int) -> str:
    return str(await asyncio.create_task(sleep(0)))


async def gather(_: int) -> str:
    return "".join(await asyncio.gather(sleep(0), wait_for_a_future(0)))[:4]


async def use_a_thread(_: int) -> str:
    return await asyncio.to_thread(lambda: "done")


async def time_out(_: int) -> str:
    try:
        async with asyncio.timeout(0):
            await asyncio.Event().wait()
    except TimeoutError:
        return "done"
    return "?"


@pytest.mark.parametrize(
    "then", [sleep, wait_for_a_future, wait_for_a_task, gather, use_a_thread, time_out]
)
def test_a_resumed_coroutine_can_wait_for_anything_else(
    run: Run, then: Callable[[int], Awaitable[str]]
) -> None:
    async def main() -> str:
        stream = Stream[int]("s")
        task = await parked(stream, then)
        stream.offer(1)
        return str(await task)

    assert run(main()) == "done"
