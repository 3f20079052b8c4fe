"""`send_wait`: senders that wait for room, one by one and with several inputs."""

from __future__ import annotations

import asyncio

import pytest

from runtime.channels.sender import Listener, Sender
from runtime.channels.streams import Stream
from runtime.errors import ChannelFullError
from tests.runtime.loops import Run, turns
from tests.runtime.small_events import Said, Shouted, Sung, said, shouted


def a_stream(bound: int = 1, name: str = "n.s") -> Stream[Said]:
    return Stream(name, bound, "wait")


def connected(*streams: Stream[Said]) -> Sender[Shouted]:
    sender = Sender("n.p", Shouted)
    sender.connect([Listener("n", s.offer, (Said,), None, s) for s in streams])
    return sender


async def send_all(sender: Sender[Shouted], texts: str) -> None:
    for text in texts:
        await sender.send_wait(shouted(text))


async def read(stream: Stream[Said], count: int) -> str:
    text = ""
    for _ in range(count):
        text += (await stream.receive()).text
        await asyncio.sleep(0)
    return text


def test_a_sender_waits_for_room_and_keeps_its_order(run: Run) -> None:
    async def main() -> tuple[int, str, int]:
        stream = a_stream(bound=2)
        sending = asyncio.create_task(send_all(connected(stream), "abcdef"))
        await turns()
        held = stream.statistics().buffered
        text = await read(stream, 6)
        await sending
        return held, text, stream.peak

    assert run(main()) == (2, "abcdef", 2)


def test_of_several_senders_each_keeps_its_order_and_none_overfills(run: Run) -> None:
    async def main() -> tuple[str, int]:
        stream = a_stream(bound=1)
        senders = [connected(stream) for _ in range(3)]
        sending = [
            asyncio.create_task(send_all(sender, text))
            for sender, text in zip(senders, ["abcd", "ABCD", "1234"], strict=True)
        ]
        text = await read(stream, 12)
        for task in sending:
            await task
        return text, stream.peak

    text, peak = run(main())
    assert ["".join(filter(part.__contains__, text)) for part in ("abcd", "ABCD", "1234")] == [
        "abcd",
        "ABCD",
        "1234",
    ]
    assert peak == 1


def test_room_in_the_first_input_may_be_gone_when_the_second_has_some(run: Run) -> None:
    async def main() -> tuple[str, str]:
        left, right = a_stream(name="n.left"), a_stream(name="n.right")
        both, one = connected(left, right), connected(left)
        sending = asyncio.create_task(send_all(both, "ab"))
        await turns()
        other = asyncio.create_task(send_all(one, "1"))
        await turns()
        heard = left.receive_nowait().text  # both senders see room here, and one takes it
        await turns()
        right.receive_nowait()
        await turns()
        heard += await read(left, 2)
        await sending
        await other
        return heard, right.receive_nowait().text

    assert run(main()) == ("a1b", "b")


def test_a_closed_input_holds_no_sender_up(run: Run) -> None:
    async def main() -> None:
        stream = a_stream()
        sending = asyncio.create_task(send_all(connected(stream), "abc"))
        await turns()
        stream.close()
        await sending

    run(main())


def test_taking_without_waiting_makes_room_too(run: Run) -> None:
    async def main() -> str:
        stream = a_stream()
        sending = asyncio.create_task(send_all(connected(stream), "ab"))
        await turns()
        first = stream.receive_nowait().text
        await sending
        return first + stream.receive_nowait().text

    assert run(main()) == "ab"


def test_a_plain_send_does_not_wait() -> None:
    stream = a_stream()
    sender = connected(stream)
    sender.send(shouted())
    with pytest.raises(ChannelFullError, match="send_wait"):
        sender.send(shouted())


def test_a_cancelled_sender_has_sent_nothing(run: Run) -> None:
    async def main() -> tuple[str, int]:
        stream = a_stream()
        sending = asyncio.create_task(send_all(connected(stream), "ab"))
        await turns()
        sending.cancel()
        await turns()
        return stream.receive_nowait().text, stream.statistics().buffered

    assert run(main()) == ("a", 0)


def test_send_wait_tells_whether_a_handler_ended_the_delivery(run: Run) -> None:
    async def main() -> bool:
        sender = Sender("n.p", Sung)
        sender.connect([Listener("n", lambda _: True, (Sung,))])
        return await sender.send_wait(Sung(stamp=0, source=""))

    assert run(main()) is True


def test_inputs_with_other_policies_hold_no_sender_up(run: Run) -> None:
    async def main() -> int:
        stream = Stream[Said]("n.s", 1, "drop_oldest")
        sender = Sender("n.p", Said)
        sender.connect([Listener("n", stream.offer, (Said,), None, stream)])
        for _ in range(3):
            await sender.send_wait(said())
        return stream.dropped

    assert run(main()) == 2
