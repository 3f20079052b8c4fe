"""What nodes know of each other before they start, and what they share while they run."""

from __future__ import annotations

import pytest

from runtime import Node, NodeConfig
from runtime.config.model import Config, RunConfig
from runtime.testing import run_nodes, spec
from runtime.tools.preflight import of_nodes
from runtime.units import Duration

FOUND: list[tuple[str, list[tuple[str, int, bool]], list[str]]] = []


class CountConfig(NodeConfig):
    count: int = 0


class Counter(Node[CountConfig]):
    """Adds its name to what all of its class share."""

    async def on_startup(self) -> None:
        known = [
            (sibling.name, sibling.config.count, sibling.here) for sibling in self.siblings(Counter)
        ]
        together = self.share("names", list[str])
        together.append(self.name)
        FOUND.append((self.name, known, together))


class Other(Node):
    """Nobody's sibling."""


NODES = (spec(Counter, "a", {"count": 1}), spec(Other, "x"), spec(Counter, "b", {"count": 2}))


@pytest.mark.parametrize("checked", [False, True])
def test_nodes_know_and_share_before_the_first_of_them_starts(checked: bool) -> None:
    FOUND.clear()
    if checked:
        assert of_nodes(Config(run=RunConfig(duration=Duration(1)), nodes=NODES)).errors == []
    else:
        run_nodes(NODES, duration=0.01)
    known = [("a", 1, True), ("b", 2, True)]
    assert [(name, siblings) for name, siblings, _ in FOUND] == [("a", known), ("b", known)]
    (_, _, first), (_, _, second) = FOUND
    assert first is second
    assert first == ["a", "b"]


def test_another_run_begins_with_nothing_shared() -> None:
    FOUND.clear()
    for _ in range(2):
        run_nodes(NODES[:1], duration=0.01)
    assert [together for _, _, together in FOUND] == [["a"], ["a"]]
