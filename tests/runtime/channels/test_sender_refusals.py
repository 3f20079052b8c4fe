"""What an output does not send: events of another type, and anything from another thread."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Event
from runtime import Input, Node, Output, on
from runtime.channels.sender import Listener, Sender
from runtime.channels.sources import SourceOwners
from runtime.channels.streams import Stream
from runtime.errors import (
    ChannelSourceError,
    ChannelThreadError,
    ChannelTypeError,
    NodeError,
)
from runtime.testing import run_nodes, spec
from tests.runtime.small_events import Said, Shouted, Sung, said, shouted

WRONG: list[Any] = [Sung(stamp=0, source="drone"), "said", None, 3, Said]


class Loud(Said):
    """Of a type without subclasses."""


def loud() -> Loud:
    return Loud(stamp=0, source="careless")


def connected(
    kind: str, event: type[Event], heard: list[Any], owners: SourceOwners | None = None
) -> Sender[Any]:
    """Return a sender that delivers in one of the ways there are."""
    sender: Sender[Any] = Sender("n.out", event)
    stream: Stream[Any] = Stream("m.in")
    listeners = {
        "handler": [Listener("m", heard.append, (event,))],
        "stream": [Listener("m", stream.offer, (event,), None, stream)],
        "narrowed": [Listener("m", heard.append, (event,), "drone")],
        "nobody": [],
        "tapped": [],
    }[kind]
    taps = [lambda _, e: heard.append(e)] if kind == "tapped" else []
    sender.connect(listeners, taps, owners=owners)
    return sender


KINDS = ["handler", "stream", "narrowed", "nobody", "tapped"]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25)
@given(right_before=st.lists(st.booleans(), max_size=4), wrong=st.sampled_from(WRONG))
def test_an_event_of_another_type_is_refused_whenever_it_comes(
    kind: str, right_before: list[bool], wrong: Any
) -> None:
    for event, right in ((Said, said()), (Loud, loud())):
        heard: list[Any] = []
        sender = connected(kind, event, heard)
        for again in right_before:
            if again:
                sender.connect(sender._candidates, sender._taps)
            sender.send(right)
        for _ in range(2):
            with pytest.raises(
                ChannelTypeError, match=rf"^n\.out: expected .* {event.__name__}, found "
            ):
                sender.send(wrong)
        assert wrong not in heard
        assert sum(sender.sent().values()) == len(right_before)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("event", [Said, Loud])
def test_the_source_of_each_event_is_checked(kind: str, event: type[Said]) -> None:
    heard: list[Any] = []
    sender = connected(kind, event, heard, SourceOwners(["n", "drone"]))
    for source in ("n", "n/below", "n"):
        sender.send(event(stamp=0, source=source))
    del heard[:]
    for _ in range(2):
        with pytest.raises(ChannelSourceError, match=r"^n\.out: .* 'drone', which is drone's$"):
            sender.send(event(stamp=0, source="drone"))
    assert not heard
    assert sender.sources == {"n", "n/below"}


def test_the_error_is_a_type_error_that_names_what_was_found() -> None:
    sender = connected("handler", Said, [])
    with pytest.raises(TypeError, match=r"n\.out: expected .* Said, found Sung\(.*\(Sung\)$"):
        sender.send(Sung(stamp=0, source="drone"))


def test_subclasses_are_of_the_type() -> None:
    heard: list[Any] = []
    connected("handler", Said, heard).send(shouted())
    assert heard == [shouted()]


def elsewhere(call: Callable[[], Any]) -> BaseException | None:
    """Call a function in a thread of its own; return what it raised."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except ChannelThreadError as error:
            raised.append(error)

    thread = threading.Thread(target=run, name="mine")
    thread.start()
    thread.join()
    return raised[0] if raised else None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("event", [said, loud])
def test_the_first_event_of_an_output_cannot_come_from_a_thread(
    kind: str, event: Callable[[], Said]
) -> None:
    heard: list[Any] = []
    sender = connected(kind, type(event()), heard)
    error = elsewhere(lambda: sender.send(event()))
    assert "n.out: expected send() in the loop's thread, found it in 'mine'" in str(error)
    assert "call_soon_threadsafe" in str(error)
    assert not heard
    sender.send(event())  # and the output is as it was
    assert sum(sender.sent().values()) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_who_is_watched_is_checked_however_often_it_has_sent_the_same(kind: str) -> None:
    sender = connected(kind, Said, [])
    for _ in range(2):
        sender.send(said())
    sender.watch()
    assert isinstance(elsewhere(lambda: sender.send(said())), ChannelThreadError)


class Careless(Node):
    """Sends from the loop, and then from a function that it offloads."""

    loud = Output(Loud)
    said = Output(Said)

    async def run(self) -> None:
        for output in (self.loud, self.said):
            sending = output.send  # whoever keeps it is not let through, either
            sending(loud())
            sending(loud())
            await self.offload(lambda: None)
            sending(loud())
            with pytest.raises(ChannelThreadError, match=r"careless\.\w+: .* 'offload_\d'"):
                await self.offload(sending, loud())
            sending(loud())
        await self.offload(self.loud.send, loud())


class Hearing(Node):
    """Notes in which thread it hears."""

    streamed = Input(Loud)
    threads: set[str]

    def __init__(self) -> None:
        self.threads = set()
        self.count = 0

    @on(Said)
    def hear(self, _: Said) -> None:
        self.threads.add(threading.current_thread().name)
        self.count += 1

    async def run(self) -> None:
        async for _ in self.streamed:
            self.threads.add(threading.current_thread().name)

    async def on_shutdown(self) -> None:
        assert self.threads == {"MainThread"}
        assert self.count == 8


def test_what_an_offloaded_function_sends_runs_nobody_elses_code_in_its_thread() -> None:
    with pytest.raises(NodeError, match=r"^careless: careless\.loud: expected send"):
        run_nodes([spec(Careless, "careless"), spec(Hearing, "hearing")])


def test_a_thread_can_hand_an_event_to_the_loop() -> None:
    class Careful(Node):
        said = Output(Said)

        async def run(self) -> None:
            loop = asyncio.get_running_loop()
            mine = said(source=self.name)
            self.said.send(mine)
            await self.offload(lambda: loop.call_soon_threadsafe(self.said.send, mine))

    assert len(run_nodes([spec(Careful, "careful")], duration=0.1).of(Said)) == 2


def test_an_output_of_a_base_class_is_checked_too() -> None:
    sender = connected("handler", Said, [])
    sender.send(Shouted(stamp=0, source="drone"))
    with pytest.raises(ChannelTypeError):
        sender.send(Sung(stamp=0, source="drone"))
