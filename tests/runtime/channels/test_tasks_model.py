"""Random programs of sends, cancellations and waits give what they give on an `asyncio.Queue`.

A reader notes what it gets, does something that a program names, and reads on. Programs cancel it
at any moment, and a new one takes its place. Whatever the moment, no event may be lost, doubled
or out of order.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.channels.streams import Stream
from tests.runtime.loops import LOOPS, Run, turns

Command = Literal["send", "cancel", "turn"]
Between = Literal["read on", "give way", "sleep", "time out", "spawn"]


class Channel:
    """A stream or a queue behind the same three names."""

    def __init__(self, kind: str, soon: bool) -> None:
        self.put: Callable[[int], None]
        self.get: Callable[[], Awaitable[int]]
        self.get_nowait: Callable[[], int]
        if kind == "queue":
            queue = asyncio.Queue[int]()
            self.put, self.get, self.get_nowait = queue.put_nowait, queue.get, queue.get_nowait
        else:
            stream = Stream[int]("s", soon=soon)
            self.put, self.get = stream.offer, stream.receive
            self.get_nowait = stream.receive_nowait


async def read(channel: Channel, seen: list[int], between: list[Between]) -> None:
    while True:
        event = await channel.get()
        seen.append(event)
        match between[event % len(between)]:
            case "give way":
                await asyncio.sleep(0)
            case "sleep":
                await asyncio.sleep(1e-6)
            case "spawn":
                await asyncio.create_task(turns(1))
            case "time out":
                try:
                    async with asyncio.timeout(0):
                        seen.append(await channel.get())
                except TimeoutError:
                    pass
            case "read on":
                pass


async def play(kind: str, soon: bool, program: list[Command], between: list[Between]) -> list[int]:
    """Return all events that the readers saw, and then those left over."""
    channel, seen, sent = Channel(kind, soon), list[int](), 0
    reader = asyncio.create_task(read(channel, seen, between))
    for command in program:
        if command == "send":
            channel.put(sent)
            sent += 1
        elif command == "turn":
            await asyncio.sleep(0)
        else:
            reader.cancel()
            await asyncio.wait([reader])
            reader = asyncio.create_task(read(channel, seen, between))
    reader.cancel()
    await asyncio.wait([reader])
    while len(seen) < sent:
        seen.append(channel.get_nowait())
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
@given(
    ours=st.booleans(),
    soon=st.booleans(),
    program=st.lists(st.sampled_from(["send", "send", "cancel", "turn"]), max_size=30),
    between=st.lists(
        st.sampled_from(["read on", "give way", "sleep", "time out", "spawn"]), min_size=1
    ),
)
@settings(max_examples=150, deadline=None)
def test_a_random_program_gives_what_it_gives_on_a_queue(
    loop: str, ours: bool, soon: bool, program: list[Command], between: list[Between]
) -> None:
    run = Run(loop, ours)
    events = run(play("stream", soon, program, between))
    assert events == run(play("queue", soon, program, between))
    assert events == list(range(program.count("send")))
