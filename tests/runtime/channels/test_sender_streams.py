"""Outputs that only streams listen to: their readers are stepped in one go, and fail alone."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

import pytest

from runtime.channels.sender import Listener, Sender
from runtime.channels.streams import Stream
from runtime.channels.tasks import DEPTH_LIMIT
from runtime.errors import ChannelFullError
from tests.runtime.loops import Run, turns
from tests.runtime.small_events import Shouted, shouted

Faults = list[tuple[object, str]]


def listener(stream: Stream[Shouted]) -> Listener:
    return Listener("n", stream.offer, (Shouted,), None, stream)


def connected(*streams: Stream[Shouted], faults: Faults | None = None) -> Sender[Shouted]:
    sender = Sender("n.p", Shouted)

    def report(deliver: Callable[[object], object], error: BaseException) -> None:
        task = asyncio.current_task()
        assert faults is not None
        assert isinstance(error, ChannelFullError)
        faults.append((deliver, task.get_name() if task else "no task"))

    sender.connect(map(listener, streams), (), report if faults is not None else None)
    return sender


def reading(stream: Stream[Shouted], log: list[str]) -> asyncio.Task[None]:
    async def read() -> None:
        async for event in stream:
            log.append(f"{stream.name} {event.text}")  # noqa: PERF401  # it never ends

    return asyncio.create_task(read(), name=stream.name)


def three_streams() -> list[Stream[Shouted]]:
    return [Stream(name, bound=1) for name in "abc"]


def test_waiting_readers_run_in_order_and_the_others_keep_the_event(run: Run) -> None:
    async def main() -> tuple[list[str], list[int]]:
        a, b, c = three_streams()
        log: list[str] = []
        tasks = [reading(a, log), reading(c, log)]
        await turns()
        assert connected(a, b, c).send(shouted("x")) is False
        await turns()
        for task in tasks:
            task.cancel()
        return log, [s.statistics().buffered for s in (a, b, c)]

    assert run(main()) == (["a x", "c x"], [0, 1, 0])


def test_a_full_stream_among_others_is_reported_in_the_senders_task(run: Run) -> None:
    async def main() -> tuple[list[str], Faults, str]:
        a, b, c = three_streams()
        log: list[str] = []
        faults: Faults = []
        tasks = [reading(a, log), reading(c, log)]
        await turns()
        b.offer(shouted())
        asyncio.current_task().set_name("sender")  # type: ignore[union-attr]
        connected(a, b, c, faults=faults).send(shouted("x"))
        name = asyncio.current_task().get_name()  # type: ignore[union-attr]
        await turns()
        for task in tasks:
            task.cancel()
        assert faults[0][0] == b.offer
        return log, [("b", who) for _, who in faults], name

    assert run(main()) == (["a x", "c x"], [("b", "sender")], "sender")


def test_without_anybody_to_report_to_the_sender_gets_the_error_in_its_own_task(run: Run) -> None:
    async def main() -> bool:
        a, b, c = three_streams()
        task = reading(a, [])
        await turns()
        b.offer(shouted())
        before = asyncio.current_task()
        with pytest.raises(ChannelFullError):
            connected(a, b, c).send(shouted("x"))
        same = asyncio.current_task() is before
        task.cancel()
        return same

    assert run(main())


def test_a_full_stream_deep_in_a_relay_is_reported_and_the_rest_still_hear(ours: Run) -> None:
    """There too where the nesting has reached its limit."""

    async def main() -> tuple[Faults, int, list[bool]]:
        full, free = Stream[Shouted]("full", bound=1), Stream[Shouted]("free")
        full.offer(shouted())
        faults: Faults = []
        relays = [Stream[Shouted](str(i)) for i in range(DEPTH_LIMIT)]
        senders = [connected(stream) for stream in relays[1:]]
        senders.append(connected(full, free, faults=faults))

        async def relay(stream: Stream[Shouted], sender: Sender[Shouted]) -> None:
            async for event in stream:
                sender.send(event)

        tasks = [asyncio.create_task(relay(*pair)) for pair in zip(relays, senders, strict=True)]
        await turns()
        relays[0].offer(shouted())
        await turns()
        alive = [not task.done() for task in tasks]
        for task in tasks:
            task.cancel()
        return faults, free.statistics().buffered, alive

    faults, buffered, alive = ours(main())
    assert len(faults) == 1
    assert buffered == 1
    assert all(alive)


def test_a_delivery_keeps_its_streams_when_a_reader_connects_anew(ours: Run) -> None:
    async def main() -> list[int]:
        a, b, c = three_streams()
        sender = connected(a, b)

        async def connect_anew() -> None:
            await a.receive()
            sender.connect([listener(c)])

        task = asyncio.create_task(connect_anew())
        await turns()
        sender.send(shouted())
        first = [s.statistics().buffered for s in (b, c)]
        b.receive_nowait()
        sender.send(shouted())
        await task
        return [*first, *(s.statistics().buffered for s in (b, c))]

    assert ours(main()) == [1, 0, 0, 1]


def test_the_count_goes_on_whatever_listens(run: Run) -> None:
    stream = Stream[Shouted]("s")
    sender = connected(stream)
    sender.send(shouted())
    sender.connect([Listener("n", lambda _: None, (Shouted,))])
    sender.send(shouted())
    sender.connect([listener(stream)])
    sender.send(shouted())
    sender.connect([Listener("n", lambda _: None, (Shouted,), "drone")])
    sender.send(shouted())
    assert sender.sent() == Counter({Shouted: 4})


def test_a_reader_that_wants_it_soon_gets_it_soon_beside_one_that_does_not(ours: Run) -> None:
    async def main() -> tuple[list[str], list[str]]:
        now, soon = Stream[Shouted]("now"), Stream[Shouted]("soon", soon=True)
        log: list[str] = []
        tasks = [reading(soon, log), reading(now, log)]
        await turns()
        connected(soon, now).send(shouted("x"))
        at_once = list(log)
        await turns()
        for task in tasks:
            task.cancel()
        return at_once, log

    assert ours(main()) == (["now x"], ["now x", "soon x"])


def test_readers_that_all_want_it_soon_get_it_after_the_sender_went_on(ours: Run) -> None:
    async def main() -> list[str]:
        soon, log = Stream[Shouted]("soon", soon=True), list[str]()
        task = reading(soon, log)
        await turns()
        connected(soon).send(shouted("x"))
        log.append("sent x")
        await turns()
        task.cancel()
        return log

    assert ours(main()) == ["sent x", "soon x"]
