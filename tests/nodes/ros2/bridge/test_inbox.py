"""The way from Zenoh's threads to the loop: bounded, at a bounded rate, one wake-up a burst."""

from __future__ import annotations

import asyncio
import functools
import time
from collections import Counter

from nodes.ros2.bridge.incoming_topic import Inbox
from nodes.ros2.bridge.keys import LOG_INTERVAL, Complaints, Message


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Box:
    """An inbox with what came out of it and what it complained of."""

    def __init__(self, depth: int = 10, rate: float = 1e6, cost: float = 0.0) -> None:
        self.clock, self.got, self.said = Clock(), list[bytes](), Counter[str]()

        def deliver(data: bytes) -> None:
            end = time.perf_counter() + cost
            while time.perf_counter() < end:
                pass
            self.got.append(data)

        self.inbox = Inbox(
            asyncio.get_running_loop(),
            deliver,
            depth=depth,
            max_rate=rate,
            max_size=100,
            complain=lambda kind, _: self.said.update([kind]),
            now=self.clock,
        )

    def give(self, *data: bytes) -> None:
        for payload in data:
            self.clock.now += 1e-3
            self.inbox.receive(Message(len(payload), functools.partial(bytes, payload)))


async def test_a_burst_wakes_the_loop_once_and_keeps_its_order() -> None:
    box = Box()
    box.give(b"1", b"2", b"3")
    await asyncio.sleep(0)
    assert box.got == [b"1", b"2", b"3"]
    box.give(b"4")
    await asyncio.sleep(0)
    assert (len(box.got), box.inbox.wake_ups) == (4, 2)


async def test_what_another_thread_gives_arrives() -> None:
    box = Box(depth=100)
    await asyncio.to_thread(box.give, *[bytes([i]) for i in range(50)])
    await asyncio.sleep(0)
    assert box.got == [bytes([i]) for i in range(50)]


async def test_what_waits_is_bounded_and_the_newest_stay() -> None:
    box = Box(depth=2)
    box.give(b"1", b"2", b"3", b"4")
    await asyncio.sleep(0)
    assert box.got == [b"3", b"4"]
    assert box.said == {"more messages than wait here": 2}


async def test_a_flood_is_dropped_before_its_bytes_are_read() -> None:
    box, read = Box(depth=10, rate=100.0), 0

    def bytes_of_it() -> bytes:
        nonlocal read
        read += 1
        return b"x"

    for _ in range(10_000):
        box.clock.now += 1e-4
        box.inbox.receive(Message(1, bytes_of_it))
        if read % 5 == 0:
            await asyncio.sleep(0)
    assert 100 <= read <= 111  # a second's worth, and a burst
    assert box.said["too many messages"] == 10_000 - read


async def test_every_message_of_a_flood_is_delivered_or_counted() -> None:
    """Whatever thread it comes in, and however slowly the loop reads."""
    box = Box(depth=5, rate=2000.0, cost=1e-5)
    sizes = [1, 1, 1, 200]

    def flood() -> None:
        for number in range(2500):
            box.clock.now += 1e-4
            box.inbox.receive(Message(sizes[number % 4], lambda: b"x"))

    async with asyncio.TaskGroup() as group:
        for _ in range(4):
            group.create_task(asyncio.to_thread(flood))
    await asyncio.sleep(0.01)
    assert box.said["message too large"] == 4 * 2500 // 4
    assert box.said["too many messages"] > 0
    assert len(box.got) + box.said.total() == 10_000


async def test_what_is_too_large_is_not_read() -> None:
    box = Box()
    box.inbox.receive(Message(101, lambda: 1 / 0))  # type: ignore[arg-type,return-value]
    assert box.said == {"message too large": 1}


async def test_slow_reading_gives_the_loop_back_between_messages() -> None:
    box = Box(cost=0.001)
    box.give(b"1", b"2", b"3")
    turns = 0
    while len(box.got) < 3:
        await asyncio.sleep(0)
        turns += 1
    assert turns >= 3
    assert box.got == [b"1", b"2", b"3"]


def test_a_message_after_the_loop_is_closed_hurts_nobody() -> None:
    async def make() -> Box:
        return Box()

    box = asyncio.run(make())
    box.give(b"1")
    assert box.got == []


def test_complaints_are_counted_always_and_told_seldom() -> None:
    told, clock = list[str](), Clock()
    complaints = Complaints(told.append, clock)
    for _ in range(1000):
        complaints.add("/a", "too many messages", "more than 5")
    complaints.add("/b", "too many messages")
    assert told == ["/a: too many messages: more than 5", "/b: too many messages"]
    clock.now = LOG_INTERVAL
    complaints.add("/a", "too many messages", "more than 5")
    assert told[2].endswith("more than 5 (1000 times since the last such line)")
    assert complaints.counts["/a", "too many messages"] == 1001
