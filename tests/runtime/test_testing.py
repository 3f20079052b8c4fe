"""The kit for tests of nodes: inputs at their stamps, outputs collected, errors raised."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

import pytest

from events import Announcement, Event
from runtime import Input, Node, NodeConfig, Output, Tick, every, on
from runtime.errors import ConfigError, NodeError, RefusedError
from runtime.testing import run_in_lockstep, run_node, run_nodes, spec
from tests.runtime.small_events import Said, Shouted, said

MS = 1_000_000


class Ready(Announcement):
    """Something is there."""


class Echo(Node):
    """Says when it heard what."""

    heard = Input(Said)
    told = Output(Shouted)

    def announce(self) -> Iterable[Announcement]:
        return [Ready(stamp=0, source=self.name)]

    async def run(self) -> None:
        async for event in self.heard:
            self.told.send(Shouted(stamp=self.clock.now(), source=self.name, text=event.text))


def at(*milliseconds: int) -> list[Event]:
    return [said(str(ms), stamp=ms * MS) for ms in milliseconds]


def test_inputs_come_at_their_stamps_and_outputs_are_collected_in_order() -> None:
    result = run_node(Echo, inputs=at(0, 10, 10, 250))
    assert [(e.stamp // MS, e.text) for e in result.of(Shouted)] == [
        (0, "0"),
        (10, "10"),
        (10, "10"),
        (250, "250"),
    ]
    assert (result.reason, result.seconds) == ("duration", 1.0)


def test_announcements_come_first_and_the_scripts_own_are_left_out() -> None:
    result = run_node(Echo, inputs=[*at(5), Ready(stamp=0, source="node")], name="node")
    assert [type(e) for e in result.sent] == [Ready, Shouted]


@pytest.mark.parametrize("kind", [list, iter])
def test_inputs_may_be_anything_that_can_be_iterated_once(kind: Any) -> None:
    inputs = kind([Ready(stamp=0, source="script"), *at(5)])
    assert [e.source for e in run_node(Echo, inputs=inputs).sent] == ["node", "node"]


def test_a_node_hears_the_scripts_announcements_before_all_else() -> None:
    class Listens(Node):
        told = Output(Said)

        def __init__(self) -> None:
            self.names: list[str] = []

        def on_announcement(self, announcement: Announcement) -> None:
            self.names.append(announcement.source)

        @on(Said)
        def hear(self, event: Said) -> None:
            self.told.send(said("".join(self.names), source=self.name))

    result = run_node(Listens, inputs=[*at(0), Ready(stamp=0, source="camera")])
    assert [e.text for e in result.of(Said)] == ["camera"]


def test_an_inputs_class_filter_tells_base_from_subclass() -> None:
    result = run_node(Echo, inputs=at(1))
    assert len(result.of(Said)) == len(result.of(Shouted)) == 1
    assert result.of(Ready)[0].source == "node"


class Counting(NodeConfig):
    hz: float
    text: str = "tick"


class Counter(Node[Counting]):
    told = Output(Said)

    @every(hz="hz")
    def count(self, tick: Tick) -> None:
        self.told.send(Said(stamp=tick.stamp, source=self.name, text=self.config.text))


def test_settings_reach_the_node_and_ticks_are_told() -> None:
    result = run_node(Counter, config={"hz": 10, "text": "t"}, duration=0.35, name="counter")
    assert [(e.stamp // MS, e.text) for e in result.of(Said)] == [
        (ms, "t") for ms in (0, 100, 200, 300)
    ]
    assert result.ticks["counter.count"].calls == 4


def test_wrong_settings_raise_where_they_are_given() -> None:
    with pytest.raises(ConfigError, match="hz"):
        run_node(Counter, config={})


def test_what_a_node_raises_is_raised() -> None:
    class Fails(Node):
        async def run(self) -> None:
            await self.clock.sleep(0.5)
            raise KeyError("lost")

    with pytest.raises(NodeError, match="node: KeyError: 'lost'") as caught:
        run_node(Fails)
    assert isinstance(caught.value.__cause__, KeyError)


def test_a_refused_announcement_is_raised() -> None:
    class Refuses(Node):
        def on_announcement(self, announcement: Announcement) -> None:
            raise ValueError("too dark")

    with pytest.raises(RefusedError, match="node: cannot work with camera: too dark"):
        run_node(Refuses, inputs=[Ready(stamp=0, source="camera")])


def test_several_nodes_talk_to_each_other_and_all_of_it_is_collected() -> None:
    result = run_nodes(
        [spec(Counter, "counter", {"hz": 2, "text": "hi"}), spec(Echo, "echo")], duration=0.9
    )
    assert [e.source for e in result.sent] == ["echo", *["counter", "echo"] * 2]


def test_drops_are_told_by_port() -> None:
    class Sleepy(Node):
        heard = Input(Said, bound=2, overflow="drop_oldest")

    result = run_node(Sleepy, inputs=at(*range(5)), name="sleepy")
    drops = result.drops["sleepy.heard"]
    assert (drops.peak, drops.dropped) == (2, 3)


def test_the_seed_decides_the_random_numbers() -> None:
    class Dice(Node):
        told = Output(Said)

        async def run(self) -> None:
            self.told.send(said(str(self.rng.integers(1 << 60)), self.name))

    def thrown(seed: int) -> list[Event]:
        return run_node(Dice, seed=seed).sent

    assert thrown(1) == thrown(1)
    assert thrown(1) != thrown(2)


def test_an_hour_takes_no_time_and_nothing_is_left_running() -> None:
    assert run_node(Counter, config={"hz": 1}, duration=3600).seconds == 3600.0


def test_a_coroutine_can_be_run_on_simulated_time() -> None:
    async def main() -> float:
        await asyncio.sleep(1e4)
        return asyncio.get_running_loop().time()

    assert run_in_lockstep(main()) == 1e4
