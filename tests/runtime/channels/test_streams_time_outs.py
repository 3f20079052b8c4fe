"""Time-outs around a stream: an event at the very moment is taken or kept, never lost.

A time-out of 0 rings when the loop next turns, so that its order with a send is exact on every
loop, without waiting.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from runtime.channels.streams import Stream
from tests.runtime.loops import Run, turns


async def timed(stream: Stream[int], arrange: Callable[[], object] = lambda: None) -> int | str:
    try:
        async with asyncio.timeout(0):
            arrange()
            return await stream.receive()
    except TimeoutError:
        return "late"


def test_a_timed_out_stream_can_be_read_again(run: Run) -> None:
    async def main() -> list[int | str]:
        stream = Stream[int]("s")
        first = await asyncio.create_task(timed(stream))
        asyncio.get_running_loop().call_soon(stream.offer, 1)
        return [first, await stream.receive()]

    assert run(main()) == ["late", 1]


def test_an_event_right_after_the_time_out_is_kept(run: Run) -> None:
    async def main() -> tuple[int | str, int]:
        stream, loop = Stream[int]("s"), asyncio.get_running_loop()
        outcome = await timed(stream, lambda: loop.call_soon(stream.offer, 1))
        return outcome, stream.receive_nowait()

    assert run(main()) == ("late", 1)


def test_an_event_right_before_the_time_out_is_taken_or_kept(run: Run) -> None:
    async def main() -> list[int | str]:
        stream = Stream[int]("s")
        task = asyncio.current_task()
        assert task is not None
        asyncio.get_running_loop().call_soon(stream.offer, 1)
        outcome = await timed(stream)
        await turns()
        assert task.cancelling() == 0
        return [outcome, stream.statistics().buffered]

    assert run(main()) == ([1, 0] if run.ours else ["late", 1])


def test_wait_for_gives_up_and_loses_nothing(run: Run) -> None:
    async def main() -> int:
        stream = Stream[int]("s")
        # The shortest time-out for which `wait_for` does start to wait.
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(stream.receive(), 1e-6)
        stream.offer(1)
        return await asyncio.wait_for(stream.receive(), 60)

    assert run(main()) == 1
