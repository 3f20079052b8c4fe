"""Streams: order, hand-over, what a full one does, and its end, on every loop and kind of task."""

from __future__ import annotations

import asyncio

import pytest

from runtime.channels.streams import TURN, Stream, StreamStatistics
from runtime.errors import ChannelBusyError, ChannelClosedError, ChannelFullError
from tests.runtime.loops import Run, turns


async def collect(stream: Stream[int], into: list[int]) -> None:
    async for event in stream:
        into.append(event)  # noqa: PERF401  # others look into it meanwhile


def offer(stream: Stream[int], *events: int) -> None:
    for event in events:
        stream.offer(event)


def held(stream: Stream[int]) -> list[int]:
    return [stream.receive_nowait() for _ in range(stream.statistics().buffered)]


def test_events_come_in_the_order_in_which_they_were_sent(run: Run) -> None:
    async def main() -> list[int]:
        stream, seen = Stream[int]("s"), list[int]()
        offer(stream, 0, 1)
        reader = asyncio.create_task(collect(stream, seen))
        await turns()
        offer(stream, 2, 3)
        await turns()
        offer(stream, 4)
        stream.close()
        await reader
        return seen

    assert run(main()) == [0, 1, 2, 3, 4]


def test_a_waiting_reader_of_ours_has_the_event_before_offer_returns(run: Run) -> None:
    async def main() -> tuple[list[int], list[int]]:
        stream, seen = Stream[int]("s"), list[int]()
        reader = asyncio.create_task(collect(stream, seen))
        await turns()
        offer(stream, 1, 2)
        at_once = list(seen)
        await turns()
        reader.cancel()
        return at_once, seen

    assert run(main()) == ([1, 2] if run.ours else [], [1, 2])


def test_soon_resumes_the_reader_after_the_sender_went_on(run: Run) -> None:
    async def main() -> tuple[list[int], list[int]]:
        stream, seen = Stream[int]("s", soon=True), list[int]()
        reader = asyncio.create_task(collect(stream, seen))
        await turns()
        offer(stream, 1, 2)
        at_once = list(seen)
        await turns()
        reader.cancel()
        return at_once, seen

    assert run(main()) == ([], [1, 2])


def test_a_full_stream_raises_in_the_sender_and_keeps_what_it_holds() -> None:
    stream = Stream[int]("node.port", bound=2)
    offer(stream, 1, 2)
    with pytest.raises(ChannelFullError, match=r"node\.port: expected room .* found 2 unread"):
        stream.offer(3)
    assert held(stream) == [1, 2]


def test_a_full_stream_that_waits_tells_a_plain_sender_how_to_wait() -> None:
    stream = Stream[int]("node.port", bound=1, overflow="wait")
    stream.offer(1)
    with pytest.raises(ChannelFullError, match="await send_wait"):
        stream.offer(2)


@pytest.mark.parametrize("bound", [1, 3])
def test_drop_oldest_keeps_the_newest_and_counts_the_rest(bound: int) -> None:
    stream = Stream[int]("s", bound, "drop_oldest")
    offer(stream, *range(10))
    assert stream.statistics() == StreamStatistics(buffered=bound, peak=bound, dropped=10 - bound)
    assert held(stream) == list(range(10))[-bound:]


def test_what_somebody_peeked_at_does_not_count_as_dropped() -> None:
    stream = Stream[int]("s", 1, "drop_oldest")
    assert stream.peek() is None
    stream.offer(1)
    assert stream.peek() == 1
    stream.offer(2)
    assert stream.dropped == 0
    stream.offer(3)
    assert stream.dropped == 1


def test_peek_shows_the_newest_and_takes_nothing() -> None:
    stream = Stream[int]("s")
    offer(stream, 1, 2)
    assert (stream.peek(), stream.peek()) == (2, 2)
    assert held(stream) == [1, 2]


def test_the_peak_outlives_the_events() -> None:
    stream = Stream[int]("s")
    offer(stream, 1, 2, 3)
    held(stream)
    stream.offer(4)
    assert stream.statistics() == StreamStatistics(buffered=1, peak=3, dropped=0)


def test_receive_nowait_tells_nothing_yet_from_closed() -> None:
    stream = Stream[int]("node.port")
    with pytest.raises(LookupError, match=r"node\.port holds nothing"):
        stream.receive_nowait()
    stream.offer(1)
    stream.close()
    assert stream.receive_nowait() == 1
    with pytest.raises(ChannelClosedError, match=r"node\.port is closed"):
        stream.receive_nowait()


def test_closing_wakes_the_reader_and_ends_its_iteration(run: Run) -> None:
    async def main() -> None:
        stream = Stream[int]("s")
        reader = asyncio.create_task(collect(stream, []))
        await turns()
        stream.close()
        stream.close()
        await reader

    run(main())


def test_a_closed_stream_can_be_read_to_its_end_and_takes_nothing_more(run: Run) -> None:
    async def main() -> list[int]:
        stream = Stream[int]("s")
        stream.offer(1)
        stream.close()
        stream.offer(2)
        seen = [await stream.receive()]
        with pytest.raises(ChannelClosedError, match="s is closed"):
            await stream.receive()
        return seen

    assert run(main()) == [1]


def test_a_second_reader_is_refused_and_the_first_still_served(run: Run) -> None:
    async def main() -> int:
        stream = Stream[int]("node.port")
        first = asyncio.create_task(stream.receive())
        await turns()
        with pytest.raises(ChannelBusyError, match=r"node\.port: another coroutine"):
            await stream.receive()
        stream.offer(1)
        return await first

    assert run(main()) == 1


def test_streams_that_wait_on_futures_end_and_refuse_a_second_reader_too(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stream, "__anext__", Stream._next_by_future)

    async def main() -> list[int]:
        stream, seen = Stream[int]("node.port"), list[int]()
        reader = asyncio.create_task(collect(stream, seen))
        await turns()
        with pytest.raises(ChannelBusyError, match=r"node\.port: another coroutine"):
            await stream.receive()
        offer(stream, 1, 2)
        stream.close()
        await reader
        return seen

    assert run(main()) == [1, 2]


def test_a_reader_that_never_runs_dry_lets_the_loop_turn(run: Run) -> None:
    async def main() -> int:
        stream, seen = Stream[int]("s", bound=3 * TURN), list[int]()
        offer(stream, *range(3 * TURN))
        reader = asyncio.create_task(collect(stream, seen))
        await turns(2)
        taken = len(seen)
        reader.cancel()
        return taken

    assert run(main()) <= 2 * TURN


def test_a_stream_emptied_while_its_reader_lets_the_loop_turn_makes_it_wait(run: Run) -> None:
    """Between the turn and the taking, somebody else may have taken the last event."""

    async def main() -> list[int]:
        stream, seen = Stream[int]("s"), list[int]()
        offer(stream, *range(TURN))
        reader = asyncio.create_task(collect(stream, seen))
        await asyncio.sleep(0)
        held(stream)
        await turns()
        stream.offer(-1)
        await turns()
        reader.cancel()
        return seen[TURN - 1 :]

    assert run(main()) == [-1]
