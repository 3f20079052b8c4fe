"""Sends inside sends: long relays, receivers that are running, and turns for everybody else."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import pytest

from runtime.channels.streams import TURN, Stream
from runtime.channels.tasks import DEPTH_LIMIT
from tests.runtime.loops import Run, turns


async def relay(source: Stream[int], target: Stream[int]) -> None:
    async for event in source:
        target.offer(event)


@pytest.mark.slow
def test_a_relay_of_five_hundred_delivers_in_order(run: Run) -> None:
    async def main() -> list[int]:
        streams = [Stream[int](str(i)) for i in range(501)]
        tasks = [asyncio.create_task(relay(a, b)) for a, b in pairwise(streams)]
        await turns()
        for event in range(20):
            streams[0].offer(event)
            if event % 3 == 0:
                await asyncio.sleep(0)
        seen = [await streams[-1].receive() for _ in range(20)]
        for task in tasks:
            task.cancel()
        return seen

    assert run(main()) == list(range(20))


def test_a_short_relay_is_done_before_offer_returns(ours: Run) -> None:
    async def main() -> int:
        streams = [Stream[int](str(i)) for i in range(DEPTH_LIMIT + 1)]
        tasks = [asyncio.create_task(relay(a, b)) for a, b in pairwise(streams)]
        await turns()
        streams[0].offer(1)
        arrived = streams[-1].statistics().buffered
        for task in tasks:
            task.cancel()
        return arrived

    assert ours(main()) == 1


def test_a_relay_cancelled_where_the_nesting_ended_keeps_the_event(ours: Run) -> None:
    async def main() -> int:
        streams = [Stream[int](str(i)) for i in range(DEPTH_LIMIT + 2)]
        tasks = [asyncio.create_task(relay(a, b)) for a, b in pairwise(streams)]
        await turns()
        streams[0].offer(1)
        for task in tasks:
            task.cancel()
        return streams[-2].receive_nowait()

    assert ours(main()) == 1


def test_a_receiver_that_is_running_has_its_buffer_filled(run: Run) -> None:
    """The reply arrives while the asker still runs; it never finds itself re-entered."""

    async def main() -> list[str]:
        there, back, log = Stream[int]("there"), Stream[int]("back"), list[str]()

        async def answer() -> None:
            async for event in there:
                log.append(f"answers {event}")
                back.offer(event)

        async def ask() -> None:
            async for event in back:
                log.append(f"hears {event}")
                if event < 3:
                    there.offer(event + 1)
                log.append(f"has asked after {event}")

        tasks = [asyncio.create_task(answer()), asyncio.create_task(ask())]
        await turns()
        back.offer(0)
        await turns(20)
        for task in tasks:
            task.cancel()
        return [line for line in log if not line.startswith("answers")]

    expected = [[f"hears {i}", f"has asked after {i}"] for i in range(4)]
    assert run(main()) == [line for pair in expected for line in pair]


def test_an_endless_ping_pong_lets_the_loop_turn(run: Run) -> None:
    async def main() -> int:
        ping, pong, count = Stream[int]("ping"), Stream[int]("pong"), 0

        async def answer() -> None:
            nonlocal count
            async for event in ping:
                count += 1
                pong.offer(event)

        tasks = [asyncio.create_task(relay(pong, ping)), asyncio.create_task(answer())]
        await turns()
        pong.offer(0)
        await turns()
        for task in tasks:
            task.cancel()
        return count

    # Each of `offer` and the three turns may serve one share of each of the two.
    assert 1 <= run(main()) <= 8 * TURN


def test_a_ring_of_many_lets_the_loop_turn(ours: Run) -> None:
    async def main() -> bool:
        ring = [Stream[int](str(i)) for i in range(100)]
        pairs = zip(ring, [*ring[1:], ring[0]], strict=True)
        tasks = [asyncio.create_task(relay(a, b)) for a, b in pairs]
        await turns()
        ring[0].offer(0)
        turned = asyncio.get_running_loop().create_future()
        asyncio.get_running_loop().call_soon(turned.set_result, True)
        result = await turned
        for task in tasks:
            task.cancel()
        return bool(result)

    assert ours(main())


def test_events_of_one_sender_reach_many_readers_in_the_readers_order(ours: Run) -> None:
    async def main() -> list[tuple[int, int]]:
        streams = [Stream[int](str(i)) for i in range(3)]
        seen: list[tuple[int, int]] = []

        async def read(number: int) -> None:
            async for event in streams[number]:
                seen.append((event, number))  # noqa: PERF401  # it never ends

        tasks = [asyncio.create_task(read(i)) for i in range(3)]
        await turns()
        for event in range(2):
            for stream in streams:
                stream.offer(event)
        for task in tasks:
            task.cancel()
        return seen

    assert ours(main()) == [(event, reader) for event in range(2) for reader in range(3)]
