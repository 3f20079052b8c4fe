"""Waiting on a stream, cut short: a cancellation loses no event, and evicts nobody else."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from runtime.channels.streams import Stream
from runtime.errors import ChannelBusyError, ChannelClosedError
from tests.runtime.loops import Run, turns


async def parked(stream: Stream[int]) -> asyncio.Task[int]:
    """Return a task that waits for one event."""
    task = asyncio.create_task(stream.receive())
    await turns()
    return task


async def ended(task: asyncio.Task[int]) -> str | int:
    """Return the result of a task, or ``cancelled``."""
    await asyncio.wait([task])
    return "cancelled" if task.cancelled() else task.result()


def test_an_event_after_the_cancellation_is_kept(run: Run) -> None:
    async def main() -> tuple[str | int, int]:
        stream = Stream[int]("s")
        task = await parked(stream)
        task.cancel()
        stream.offer(1)
        return await ended(task), await stream.receive()

    assert run(main()) == ("cancelled", 1)


def test_an_event_before_the_cancellation_is_taken_or_kept_but_not_lost(run: Run) -> None:
    """A reader of ours has taken it and ended; one in a stock task has not run yet."""

    async def main() -> tuple[str | int, int]:
        stream = Stream[int]("s")
        task = await parked(stream)
        stream.offer(1)
        task.cancel()
        return await ended(task), stream.statistics().buffered

    assert run(main()) == ((1, 0) if run.ours else ("cancelled", 1))


def test_a_reader_woken_soon_and_cancelled_before_it_ran_leaves_the_event(run: Run) -> None:
    async def main() -> tuple[str | int, int]:
        stream = Stream[int]("s", soon=True)
        task = await parked(stream)
        stream.offer(1)
        task.cancel()
        return await ended(task), stream.receive_nowait()

    assert run(main()) == ("cancelled", 1)


def test_cancelling_a_woken_reader_does_not_evict_the_one_that_waits_now(ours: Run) -> None:
    async def main() -> str | int:
        stream = Stream[int]("s", soon=True)
        first = await parked(stream)
        second = asyncio.create_task(stream.receive())
        asyncio.get_running_loop().call_soon(first.cancel)
        stream.offer(1)  # wakes the first, after both of the above
        stream.receive_nowait()
        await turns()
        stream.offer(2)
        await turns()
        for task in (first, second):
            task.cancel()
        return await ended(second)

    assert ours(main()) == 2


def test_a_task_group_in_a_reader_reads_and_cancels(run: Run) -> None:
    """One failing child takes the other, which waits on a stream, with it."""

    async def main() -> tuple[int, str]:
        stream, other = Stream[int]("s"), Stream[int]("t")

        async def fail_after_an_event() -> None:
            raise ValueError(str(await stream.receive()))

        async def reader() -> int:
            first = await stream.receive()
            async with asyncio.TaskGroup() as group:
                group.create_task(other.receive())
                group.create_task(fail_after_an_event())
            return first

        task = asyncio.create_task(reader())
        await turns()
        stream.offer(1)
        await turns()
        stream.offer(2)
        with pytest.raises(ExceptionGroup) as caught:
            await task
        other.offer(3)
        return other.receive_nowait(), str(caught.value.exceptions[0])

    assert run(main()) == (3, "2")


def test_a_reader_that_refuses_to_be_cancelled_reads_on(run: Run) -> None:
    async def main() -> tuple[str | int, int]:
        stream = Stream[int]("s")

        async def stubborn() -> int:
            try:
                return await stream.receive()
            except asyncio.CancelledError:
                task = asyncio.current_task()
                assert task is not None
                task.uncancel()
                return await stream.receive()

        task = asyncio.create_task(stubborn())
        await turns()
        task.cancel()
        await turns()
        stream.offer(1)
        return await ended(task), task.cancelling()

    assert run(main()) == (1, 0)


def test_a_woken_reader_that_finds_another_waiting_is_refused_and_evicts_nobody(run: Run) -> None:
    async def main() -> tuple[bool, int]:
        stream = Stream[int]("s", soon=True)
        first = await parked(stream)
        second = asyncio.create_task(stream.receive())
        stream.offer(1)  # wakes the first, after the second has begun
        stream.receive_nowait()
        await turns()
        refused = first.done() and isinstance(first.exception(), ChannelBusyError)
        stream.offer(2)
        await turns()
        first.cancel()
        return refused, second.result() if second.done() else 0

    assert run(main()) == (True, 2)


def test_a_stream_closed_under_a_context_manager_of_a_reader_says_so(run: Run) -> None:
    """What ends an ``async for`` must not be taken for the end of anything around it."""

    @contextlib.asynccontextmanager
    async def around() -> AsyncIterator[None]:
        yield

    async def main() -> None:
        stream = Stream[int]("s")
        stream.close()
        async with around():
            await stream.receive()

    with pytest.raises(ChannelClosedError, match="s is closed"):
        run(main())
