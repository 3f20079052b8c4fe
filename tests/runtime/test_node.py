"""Making a node: what it has before its `__init__`, its settings' type and its random numbers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

import pytest

from runtime import Input, Node, NodeConfig, Output
from runtime.errors import ChannelClosedError
from runtime.host import Host
from tests.runtime.small_events import NoHost, Said, make, said

C = TypeVar("C", bound=NodeConfig)


class Speed(NodeConfig):
    speed: float = 1.0


class Height(NodeConfig):
    height: float = 2.0


def test_the_settings_type_stands_in_the_base() -> None:
    class Plain(Node): ...

    class Fast(Node[Speed]): ...

    class Faster(Fast): ...

    assert Plain.config_type is NodeConfig
    assert Fast.config_type is Speed
    assert Faster.config_type is Speed


def test_the_settings_type_may_come_through_a_generic_base_of_ones_own() -> None:
    class Family(Node[C]): ...

    class Member(Family[Height]): ...

    assert Family.config_type is NodeConfig
    assert Member.config_type is Height


def test_a_settings_type_given_as_attribute_stays() -> None:
    class Fast(Node[Speed]): ...

    class High(Fast):
        config_type = Height

    assert High.config_type is Height


def test_all_is_there_before_an_init_that_calls_no_super() -> None:
    class Eager(Node[Speed]):
        heard = Input(Said)
        told = Output(Said)

        def __init__(self) -> None:
            self.attributes = (self.name, self.config.speed, self.clock.now(), self.heard.name)
            try:
                self.told.send(said())
            except ChannelClosedError as error:
                self.refusal = str(error)

    node = make(Eager, "eager", Speed(speed=3.0))
    assert node.attributes == ("eager", 3.0, 0, "eager.heard")
    assert "eager.told" in node.refusal


def test_two_nodes_of_one_class_have_ports_of_their_own() -> None:
    class Pair(Node):
        heard = Input(Said)

    one, other = make(Pair, "one"), make(Pair, "other")
    one.heard.offer(said())
    assert (one.heard.statistics().buffered, other.heard.statistics().buffered) == (1, 0)


def test_random_numbers_depend_on_the_seed_and_the_name_only() -> None:
    class One(Node): ...

    class Other(Node):
        heard = Input(Said)

    def draw(cls: type[Node], name: str, seed: int) -> list[float]:
        return list(make(cls, name, seed=seed).rng.random(4))

    assert draw(One, "a", 1) == draw(Other, "a", 1)
    assert draw(One, "a", 1) != draw(One, "b", 1)
    assert draw(One, "a", 1) != draw(One, "a", 2)


@pytest.mark.parametrize(
    "use",
    [
        lambda host: host.start(None, None),
        lambda host: host.every(None, 1.0, print, "node.print"),
        lambda host: asyncio.run(host.worker(None, print, ())),
        lambda host: host.hold(None, "slam", None, 0.0),
        lambda host: host.offload(None, None),
    ],
)
def test_a_host_that_runs_nothing_says_so(use: Callable[[Host], Any]) -> None:
    with pytest.raises(NotImplementedError):
        use(NoHost())
