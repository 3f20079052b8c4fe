"""The graph: all others that know an event hear it, in the order of the nodes and declarations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from events import Event
from runtime import Input, Node, Output, on
from runtime.channels.sender import Listener
from runtime.run.graph import connect, edges, unconnected
from tests.runtime.small_events import Said, Shouted, Sung, make, said, shouted

log: list[str] = []


class Speaker(Node):
    told = Output(Said)

    @on(Said)
    def hear(self, event: Said) -> None:
        log.append(f"{self.name} {event.text}")


class Singer(Node):
    anything = Output(Event)


class Crowd(Node):
    @on(Shouted)
    def startle(self, event: Shouted) -> None:
        log.append(f"{self.name} startled")

    said = Input(Said)

    @on(Event)
    def note(self, event: Event) -> None:
        log.append(f"{self.name} holds {self.said.statistics().buffered}")


def connected(*nodes: Node[Any], sources: Mapping[str, Mapping[str, str]] | None = None) -> None:
    log.clear()
    for node in nodes:
        node.sources = dict((sources or {}).get(node.name, {}))
    connect(nodes)


def test_a_node_does_not_hear_itself() -> None:
    one, other = make(Speaker, "one"), make(Speaker, "other")
    connected(one, other)
    one.told.send(said("hello"))
    assert log == ["other hello"]


def test_listeners_hear_in_the_order_of_nodes_and_of_declarations() -> None:
    crowd, speaker, second = make(Crowd, "c"), make(Speaker, "s"), make(Crowd, "d")
    connected(crowd, speaker, second)
    speaker.told.send(shouted())
    assert log == ["c startled", "c holds 1", "d startled", "d holds 1"]


def test_an_output_of_a_base_type_reaches_those_who_know_the_event_it_sends() -> None:
    singer, crowd, speaker = make(Singer, "singer"), make(Crowd, "c"), make(Speaker, "s")
    connected(singer, crowd, speaker)
    singer.anything.send(Sung(stamp=0, source=""))
    assert log == ["c holds 0"]
    singer.anything.send(said("x"))
    assert log == ["c holds 0", "c holds 1", "s x"]


def test_the_file_narrows_a_port_to_a_source() -> None:
    singer, speaker = make(Singer, "singer"), make(Speaker, "s")
    connected(singer, speaker, sources={"s": {"hear": "drone/front"}})
    singer.anything.send(said("near", source="drone/front/left"))
    singer.anything.send(said("far", source="drone/back"))
    assert log == ["s near"]


def test_the_file_overrules_the_source_of_a_declaration() -> None:
    class Picky(Speaker):
        @on(Said, source="drone")
        def hear(self, event: Said) -> None:
            log.append(event.source)

    singer, picky = make(Singer, "singer"), make(Picky, "p")
    for sources, heard in (({}, ["drone"]), ({"p": {"hear": "other"}}, ["other"])):
        connected(singer, picky, sources=sources)
        for source in ("drone", "other"):
            singer.anything.send(said(source=source))
        assert log == heard


def test_the_last_listeners_come_after_all_nodes() -> None:
    singer, speaker = make(Singer, "singer"), make(Speaker, "s")
    log.clear()
    last = Listener("run", lambda _: log.append("last"), (Event,))
    connect([singer, speaker], last=[last])
    singer.anything.send(said("x"))
    assert log == ["s x", "last"]


def test_a_node_left_out_hears_nothing_more() -> None:
    singer, speaker = make(Singer, "singer"), make(Speaker, "s")
    connected(singer, speaker)
    connect([singer])
    singer.anything.send(said())
    assert log == []


def test_edges_are_known_from_the_classes() -> None:
    assert edges([("s", Speaker), ("c", Crowd)]) == [
        ("s", "told", "Said", "c", "startle"),
        ("s", "told", "Said", "c", "said"),
        ("s", "told", "Said", "c", "note"),
    ]


def test_an_input_that_nobody_sends_to_is_unconnected() -> None:
    class Lonely(Node):
        songs = Input(Sung)

        @on(Sung)
        def handler(self, event: Sung) -> None: ...

    nodes: list[tuple[str, type[Node[Any]]]] = [("l", Lonely), ("s", Speaker)]
    assert unconnected(nodes) == [("l", "songs", "Sung")]
    assert unconnected([*nodes, ("singer", Singer)]) == []
