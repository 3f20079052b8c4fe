"""Senders: who hears what, in which order, and what a failing listener does to the others."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from events import Event
from runtime.channels.sender import Deliver, Listener, Sender
from runtime.channels.streams import Stream
from runtime.errors import ChannelClosedError
from tests.runtime.loops import Run, turns
from tests.runtime.small_events import Said, Shouted, Sung, said, shouted

Ways = Callable[[Sender[Said], list[Listener]], None]


def handler(call: Deliver, *events: type[Event], source: str | None = None) -> Listener:
    return Listener("n", call, events or (Event,), source)


def to_all(sender: Sender[Any], listeners: list[Listener]) -> None:
    """Connect so that the shortest way of delivery is taken."""
    sender.connect(listeners)
    assert sender.send == sender._send_to_all


def routed(sender: Sender[Any], listeners: list[Listener]) -> None:
    """Connect so that deliveries are routed."""
    sender.connect([*listeners, handler(lambda _: None, source="elsewhere")])
    assert sender.send == sender._send_routed


def tapped(sender: Sender[Any], listeners: list[Listener]) -> None:
    """Connect so that a tap looks on."""
    sender.connect(listeners, [lambda *_: None])
    assert sender.send == sender._send_tapped


@pytest.fixture(params=[to_all, routed, tapped], ids=lambda way: str(way.__name__))
def connect(request: pytest.FixtureRequest) -> Ways:
    """Connect in each of the three ways of delivery."""
    way: Ways = request.param
    return way


def a_sender(event: type[Any] = Shouted) -> Sender[Any]:
    """Return a sender of a type that has no subclasses."""
    return Sender("node.port", event)


def test_handlers_and_streams_hear_an_event_in_order(connect: Ways) -> None:
    log: list[str] = []
    stream = Stream[Said]("n.s")
    sender = a_sender()
    connect(
        sender,
        [
            handler(lambda _: log.append("first")),
            Listener("n", stream.offer, (Said,), None, stream),
            handler(lambda _: log.append(f"stream holds {stream.statistics().buffered}")),
        ],
    )
    assert sender.send(shouted()) is False
    assert log == ["first", "stream holds 1"]


def test_true_ends_the_delivery_for_handlers_and_streams_after_it(connect: Ways) -> None:
    stream = Stream[Said]("n.s")
    sender = a_sender()
    connect(sender, [handler(lambda _: True), Listener("n", stream.offer, (Said,), None, stream)])
    assert sender.send(shouted()) is True
    assert stream.statistics().buffered == 0


def test_a_handler_that_sends_has_its_event_delivered_before_its_own_goes_on(
    connect: Ways,
) -> None:
    log: list[str] = []
    outer, inner = a_sender(), a_sender()

    def pass_on(event: Said) -> None:
        inner.send(shouted("inner"))
        log.append("passed on")

    connect(inner, [handler(lambda e: log.append(e.text))])
    connect(outer, [handler(pass_on), handler(lambda e: log.append(e.text))])
    outer.send(shouted("outer"))
    assert log == ["inner", "passed on", "outer"]


@pytest.mark.parametrize(
    ("source", "heard"),
    [
        ("drone", True),
        ("drone/front", True),
        ("drone/front/left", True),
        ("drone2", False),
        ("dron", False),
        ("a/drone", False),
        ("", False),
    ],
)
def test_a_source_takes_what_is_below_it_by_path_segment(source: str, heard: bool) -> None:
    log: list[Event] = []
    sender = a_sender(Said)
    sender.connect([handler(log.append, source="drone")])
    sender.send(said(source=source))
    assert bool(log) is heard


def test_events_are_routed_by_type_and_subclasses_come_too() -> None:
    log: list[str] = []
    sender = a_sender(Event)
    sender.connect(
        [
            handler(lambda _: log.append("said"), Said),
            handler(lambda _: log.append("shouted"), Shouted),
            handler(lambda _: log.append("said or sung"), Said, Sung),
        ]
    )
    for event in (said(), shouted(), Sung(stamp=0, source="")):
        sender.send(event)
    assert log == [
        *("said", "said or sung"),
        *("said", "shouted", "said or sung"),
        *("said or sung",),
    ]


def test_a_listener_to_several_types_hears_those_that_the_output_can_send() -> None:
    log: list[Event] = []
    sender = a_sender(Said)
    sender.connect([handler(log.append, Shouted, Sung)])
    sender.send(said())
    sender.send(shouted())
    assert log == [shouted()]


def test_events_are_counted_by_type(connect: Ways) -> None:
    sender = a_sender()
    connect(sender, [handler(lambda _: True)])
    sender.send(shouted())
    sender.send(shouted(source="elsewhere"))
    assert sender.sent() == Counter({Shouted: 2})


def test_types_that_were_never_sent_are_not_counted() -> None:
    sender = a_sender(Said)
    sender.connect([])
    sender.send(shouted())
    assert sender.sent() == Counter({Shouted: 1})


def test_taps_see_everything_first_even_what_nobody_hears() -> None:
    log: list[str] = []
    sender = a_sender()
    sender.connect(
        [handler(lambda _: log.append("handler"))],
        [lambda s, e: log.append(f"tap {s.name if s else None} {type(e).__name__}")],
    )
    sender.send(shouted())
    sender.connect([], [lambda *_: log.append("lonely tap")])
    sender.send(shouted())
    assert log == ["tap node.port Shouted", "handler", "lonely tap"]


def test_sending_before_the_first_update_is_refused_with_a_hint() -> None:
    with pytest.raises(ChannelClosedError, match=r"node\.port: Said sent before the first update"):
        a_sender(Said).send(said())


def test_send_soon_delivers_after_the_sender_went_on(run: Run) -> None:
    async def main() -> list[str]:
        log: list[str] = []
        sender = a_sender()
        sender.connect([handler(lambda e: log.append(e.text))])
        sender.send_soon(shouted("one"))
        sender.send_soon(shouted("two"))
        log.append("sender")
        await turns(1)
        return log

    assert run(main()) == ["sender", "one", "two"]


def test_send_soon_goes_to_those_connected_when_it_is_delivered(run: Run) -> None:
    """Connecting anew in between may call for another way of delivery."""

    async def main() -> list[Event]:
        log: list[Event] = []
        sender = a_sender()
        to_all(sender, [])
        sender.send_soon(shouted(source="drone"))
        sender.connect([handler(log.append, source="other")])
        await asyncio.sleep(0)
        return log

    assert run(main()) == []
