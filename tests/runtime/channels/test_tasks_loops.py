"""Several loops in one process, and sets of tasks: neither changes the order of anything."""

from __future__ import annotations

import asyncio
import random
import threading
from itertools import pairwise

from runtime.channels.streams import Stream
from runtime.channels.tasks import DEPTH_LIMIT
from runtime.testing import run_in_lockstep

RELAYS: list[asyncio.Task[None]] = []


async def relay(source: Stream[int], target: Stream[int]) -> None:
    async for event in source:
        target.offer(event)


async def relayed(count: int) -> list[Stream[int]]:
    """Return streams that hand on to one another what the first is offered."""
    streams = [Stream[int](str(i)) for i in range(count)]
    for source, target in pairwise(streams):
        RELAYS.append(asyncio.create_task(relay(source, target)))
    for _ in range(3):
        await asyncio.sleep(0)
    return streams


def test_how_deep_one_loop_is_does_not_count_for_another() -> None:
    deep, go_on = threading.Event(), threading.Event()

    async def dive() -> None:
        streams = await relayed(DEPTH_LIMIT)

        async def linger() -> None:
            async for _ in streams[-1]:
                deep.set()
                go_on.wait(10.0)

        lingering = asyncio.create_task(linger())
        await asyncio.sleep(0)
        streams[0].offer(1)
        lingering.cancel()

    async def at_once() -> int:
        streams = await relayed(3)
        streams[0].offer(1)
        return streams[-1].statistics().buffered

    thread = threading.Thread(target=run_in_lockstep, args=(dive(),))
    thread.start()
    try:
        assert deep.wait(10.0)
        assert run_in_lockstep(at_once()) == 1
    finally:
        go_on.set()
        thread.join()


def cancelled_order(tasks: int, done_first: set[int]) -> list[int]:
    """Return in which order a group cancels its tasks, some of which have ended before."""
    order: list[int] = []

    async def wait(number: int) -> None:
        try:
            await asyncio.sleep(1.0 if number in done_first else 100.0)
        except asyncio.CancelledError:
            order.append(number)
            raise

    async def fail() -> None:
        await asyncio.sleep(2.0)
        raise RuntimeError("out of order")

    async def main() -> None:
        clutter = [bytearray(random.randint(1, 4000)) for _ in range(50)]  # other addresses
        try:
            async with asyncio.TaskGroup() as group:
                for number in range(tasks):
                    group.create_task(wait(number))
                    clutter.append(bytearray(random.randint(1, 4000)))
                group.create_task(fail())
        except ExceptionGroup:
            pass

    run_in_lockstep(main())
    return order


def test_a_group_cancels_its_tasks_in_the_same_order_each_time() -> None:
    first = cancelled_order(40, {3, 17, 21})
    assert len(first) == 37
    assert all(cancelled_order(40, {3, 17, 21}) == first for _ in range(8))


def test_tasks_that_somebody_else_makes_do_not_change_that_order() -> None:
    def order(lookers: int) -> list[str]:
        names: list[str] = []

        async def look() -> None:
            await asyncio.sleep(5.0)

        async def own() -> None:
            pending = {asyncio.create_task(look(), name=str(n)) for n in range(12)}
            names.extend(task.get_name() for task in pending)
            await asyncio.wait(pending)

        async def main() -> None:
            looking = [asyncio.create_task(look()) for _ in range(lookers)]
            owner = asyncio.create_task(own())
            await asyncio.wait([*looking, owner])

        run_in_lockstep(main())
        return names

    assert order(0) == order(1) == order(7)


def test_equal_numbers_are_different_tasks() -> None:
    async def child() -> None:
        await asyncio.sleep(0)

    async def parent() -> asyncio.Task[None]:
        return asyncio.create_task(child())

    async def main() -> int:
        made = [await asyncio.create_task(parent()) for _ in range(5)]
        return len(set(made))

    assert run_in_lockstep(main()) == 5
