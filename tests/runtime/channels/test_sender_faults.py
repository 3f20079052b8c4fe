"""Listeners that raise, and listeners that come and go while a delivery is going on."""

from __future__ import annotations

import pytest

from events import Event
from runtime.channels.sender import Deliver, Listener, Sender
from runtime.channels.streams import Stream
from runtime.errors import ChannelFullError, HandlerCircleError
from tests.runtime.small_events import Said, Shouted, shouted

# A source filter on one listener makes a sender take the longer of its two ways of delivery.
SOURCES = pytest.mark.parametrize("source", [None, "drone"], ids=["to all", "routed"])


def handler(call: Deliver, source: str | None = None) -> Listener:
    return Listener("n", call, (Event,), source)


def fail(_: Event) -> None:
    raise ValueError("broken")


def fail_too(_: Event) -> None:
    raise KeyError("broken too")


@SOURCES
def test_a_failing_listener_is_reported_and_the_rest_still_hear(source: str | None) -> None:
    faults: list[tuple[Deliver, str]] = []
    log: list[Event] = []
    sender = Sender("n.p", Shouted)
    listeners = [handler(fail, source), handler(fail_too), handler(log.append)]
    sender.connect(listeners, (), lambda deliver, error: faults.append((deliver, repr(error))))
    event = shouted()
    assert sender.send(event) is False
    assert faults == [(fail, "ValueError('broken')"), (fail_too, "KeyError('broken too')")]
    assert log == [event]


@SOURCES
def test_true_ends_a_delivery_after_a_fault_too(source: str | None) -> None:
    log: list[Event] = []
    sender = Sender("n.p", Shouted)
    listeners = [handler(fail, source), handler(lambda _: True), handler(log.append)]
    sender.connect(listeners, (), lambda *_: None)
    assert sender.send(shouted()) is True
    assert log == []


@SOURCES
def test_without_anybody_to_report_to_the_sender_gets_the_error(source: str | None) -> None:
    log: list[Event] = []
    sender = Sender("n.p", Shouted)
    sender.connect([handler(fail, source), handler(log.append)])
    with pytest.raises(ValueError, match="broken"):
        sender.send(shouted())
    assert log == []


def test_a_full_stream_is_a_fault_of_the_stream() -> None:
    stream = Stream[Said]("n.s", bound=1)
    faults: list[tuple[Deliver, type[BaseException]]] = []
    sender = Sender("n.p", Shouted)
    listener = Listener("n", stream.offer, (Said,), None, stream)
    sender.connect([listener], (), lambda who, error: faults.append((who, type(error))))
    sender.send(shouted())
    sender.send(shouted())
    assert faults == [(stream.offer, ChannelFullError)]


@SOURCES
def test_a_running_delivery_keeps_its_listeners_and_the_next_has_the_new(
    source: str | None,
) -> None:
    log: list[str] = []
    sender = Sender("n.p", Shouted)
    old = handler(lambda _: log.append("old"))
    new = handler(lambda _: log.append("new"))

    def swap(_: Event) -> None:
        sender.connect([handler(lambda _: None, source), new])

    sender.connect([handler(swap, source), old])
    sender.send(shouted())
    assert log == ["old"]
    sender.send(shouted())
    assert log == ["old", "new"]


@SOURCES
def test_a_fault_after_a_change_of_listeners_ends_the_old_delivery_in_order(
    source: str | None,
) -> None:
    log: list[str] = []
    faults: list[Deliver] = []
    sender = Sender("n.p", Shouted)
    old = handler(lambda _: log.append("old"))
    new = handler(lambda _: log.append("new"))

    def report(deliver: Deliver, _: BaseException) -> None:
        faults.append(deliver)

    def leave_and_fail(event: Event) -> None:
        sender.connect([handler(lambda _: None, source), new], (), report)
        fail(event)

    sender.connect([handler(leave_and_fail, source), old], (), report)
    sender.send(shouted())
    assert (log, faults) == (["old"], [leave_and_fail])


@SOURCES
def test_a_nested_delivery_has_its_own_faults(source: str | None) -> None:
    faults: list[Deliver] = []
    log: list[str] = []
    outer, inner = Sender("n.outer", Shouted), Sender("n.inner", Shouted)

    def report(deliver: Deliver, _: BaseException) -> None:
        faults.append(deliver)

    def pass_on(event: Shouted) -> None:
        inner.send(event)
        log.append("passed on")

    inner.connect([handler(fail, source)], (), report)
    outer.connect([handler(pass_on, source)], (), report)
    outer.send(shouted())
    assert (faults, log) == ([fail], ["passed on"])


class Replies:
    """Sends each event on; as a node, it has a name."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.out = Sender(f"{name}.out", Shouted)

    def reply(self, event: Shouted) -> None:
        self.out.send(event)


@SOURCES
def test_handlers_that_answer_one_another_are_one_error_of_the_first_delivery(
    source: str | None,
) -> None:
    begins, a, b = map(Replies, ("begins", "a", "b"))
    faults: list[tuple[Deliver, BaseException]] = []
    for node, other in ((begins, a), (a, b), (b, a)):
        listeners = [handler(other.reply, source)]
        node.out.connect(listeners, (), lambda *fault: faults.append(fault))

    def send_at(depth: int) -> None:
        if depth:
            send_at(depth - 1)
        else:
            begins.out.send(shouted())

    for depth in range(9):  # the stack may be full at any call of a delivery
        del faults[:]
        send_at(depth)
        ((deliver, error),) = faults
        assert deliver == a.reply
        assert isinstance(error, HandlerCircleError)
        text = str(error).partition(" one another: ")[2]
        assert text in {"a.out → b.reply, b.out → a.reply", "b.out → a.reply, a.out → b.reply"}


def test_a_handler_that_calls_itself_for_ever_is_no_circle() -> None:
    def recurse(event: Event) -> None:
        recurse(event)

    faults: list[str] = []
    sender = Sender("n.p", Shouted)
    sender.connect([handler(recurse)], (), lambda _, error: faults.append(type(error).__name__))
    sender.send(shouted())
    assert faults == ["RecursionError"]
