"""Declarations: what a class declares is found in order, and mistakes are named at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from events import Event
from runtime import Input, Node, Output, Tick, every, on
from runtime.channels.streams import Stream
from runtime.errors import DeclarationError
from tests.runtime.small_events import Said, Shouted, Sung, make


class Base(Node):
    heard = Input(Said)
    told = Output(Said)

    @on(Sung)
    def sung(self, event: Sung) -> None: ...

    @every(hz=10)
    def beat(self, tick: Tick) -> None: ...


def test_inputs_and_handlers_listen_in_the_order_of_the_class_body() -> None:
    class Mixed(Node):
        @on(Said)
        def first(self, event: Said) -> None: ...

        second = Input(Said)

        @on(Sung)
        def third(self, event: Sung) -> None: ...

    assert Mixed.declared.listening == ["first", "second", "third"]


def test_a_subclass_declares_what_its_base_does_first_and_then_its_own() -> None:
    class Derived(Base):
        more = Input(Sung)
        also = Output(Sung)

    assert Derived.declared.listening == ["heard", "sung", "more"]
    assert list(Derived.declared.outputs) == ["told", "also"]
    assert list(Derived.declared.ticks) == ["beat"]
    assert Base.declared.listening == ["heard", "sung"]


def test_overriding_keeps_the_place_and_changes_the_declaration() -> None:
    class Derived(Base):
        more = Input(Sung)
        heard: Any = Input(Shouted)

        @every(hz=20)
        def beat(self, tick: Tick) -> None: ...

    assert Derived.declared.listening == ["heard", "sung", "more"]
    assert Derived.declared.inputs["heard"].event is Shouted
    assert Derived.declared.ticks["beat"].hz == 20
    assert Base.declared.inputs["heard"].event is Said


def test_overriding_without_declaring_takes_the_declaration_away() -> None:
    class Derived(Base):
        heard: Any = None

        def sung(self, event: Sung) -> None: ...

        def beat(self, tick: Tick) -> None: ...

    assert Derived.declared.listening == []
    assert Derived.declared.ticks == {}


def test_a_handler_can_also_be_overridden_by_an_input() -> None:
    class Derived(Base):
        sung: Any = Input(Sung)

    assert Derived.declared.listening == ["heard", "sung"]
    assert Derived.declared.handlers == {}


def test_declarations_reach_the_stream() -> None:
    class Reader(Node):
        newest = Input(Said, keep="latest")
        some = Input(Said, bound=3, overflow="wait", source="drone")

    node = make(Reader, "reader")
    assert isinstance(node.newest, Stream)
    assert (node.newest.bound, node.newest.overflow) == (1, "drop_oldest")
    assert (node.some.bound, node.some.overflow, node.some.name) == (3, "wait", "reader.some")
    assert Reader.some.source == "drone"


@pytest.mark.parametrize(
    ("declare", "message"),
    [
        (lambda: Input(int), r"Input: expected a subclass of Event, found <class 'int'>"),  # type: ignore[type-var]
        (lambda: Output("Said"), r"Output: expected a subclass of Event, found 'Said'"),  # type: ignore[arg-type]
        (lambda: on(Said, int), r"@on: expected a subclass of Event, found <class 'int'>"),  # type: ignore[arg-type]
        (lambda: on(), r"@on: expected an event type, found nothing"),
        (lambda: Input(Said, keep="some"), r'keep: expected "every" or "latest", found \'some\''),  # type: ignore[arg-type]
        (lambda: Input(Said, overflow="drop"), r"overflow: expected .*, found 'drop'"),  # type: ignore[arg-type]
        (lambda: Input(Said, wake="later"), r'wake: expected "now" or "soon", found \'later\''),  # type: ignore[arg-type]
        (lambda: Input(Said, bound=0), r"bound: expected at least 1, found 0"),
        (lambda: every(hz=0), r"@every: hz: expected a rate above 0, up to 100000, found 0"),
        (lambda: every(hz=-1.5), r"found -1\.5"),
        (lambda: every(hz=1e6), r"found 1000000\.0"),
        (lambda: every(hz=float("nan")), r"found nan"),
    ],
)
def test_a_wrong_declaration_says_what_was_expected_and_found(
    declare: Callable[[], object], message: str
) -> None:
    with pytest.raises(DeclarationError, match=message):
        declare()


def test_a_handler_that_waits_is_refused_with_the_way_out() -> None:
    with pytest.raises(DeclarationError, match=r"handle: expected a plain .* read an Input in run"):

        class Waiting(Node):
            @on(Said)
            async def handle(self, event: Said) -> None: ...


@pytest.mark.parametrize("name", ["run", "name", "clock", "on_startup", "offload", "_host"])
@pytest.mark.parametrize("port", [Input(Event), Output(Event)], ids=["input", "output"])
def test_names_that_every_node_has_are_refused_for_ports(name: str, port: Any) -> None:
    with pytest.raises(DeclarationError, match=rf"Clash\.{name}: every node has an attribute"):
        type("Clash", (Node,), {name: port})


def test_a_port_on_the_class_is_its_declaration() -> None:
    assert isinstance(Base.heard, Input)
    assert isinstance(Base.told, Output)


def test_a_node_made_by_hand_says_that_its_ports_come_with_a_run() -> None:
    node = Base()
    for port in ("heard", "told"):
        with pytest.raises(AttributeError, match=rf"Base\.{port} exists once a run has made"):
            getattr(node, port)
