"""Nodes that fail in a phase before the first update: each error has its node's name."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

import pytest

from events import Announcement
from runtime import Node, NodeConfig
from runtime.errors import NodeError, RefusedError
from runtime.run.node_runner import NodeRunner
from runtime.testing import run_in_lockstep, run_nodes, spec


class Phases(NodeConfig):
    fails: str = ""


class Fails(Node[Phases]):
    """Fails in the phase that its settings name."""

    def __init__(self) -> None:
        if self.config.fails == "init":
            raise LookupError("no wires")

    def announce(self) -> Iterable[Announcement]:
        announced: dict[str, list[Any]] = {
            "announces 3": [3],
            "announces another's": [Announcement(stamp=0, source="drone")],
        }
        if self.config.fails == "announce":
            raise LookupError("no words")
        return announced.get(self.config.fails, [])

    def on_announcement(self, announcement: Announcement) -> None:
        if self.config.fails == "on_announcement":
            raise LookupError("no ears")
        if self.config.fails == "refuses":
            raise ValueError("too loud")

    def check(self) -> Iterable[str]:
        if self.config.fails == "check":
            raise LookupError("no eyes")
        return ["a rope is missing", "so is a hook"] if self.config.fails == "lacks" else []


class Drone(Node):
    def announce(self) -> Iterable[Announcement]:
        yield Announcement(stamp=0, source="drone/imu")


@pytest.mark.parametrize(
    ("fails", "kind", "text"),
    [
        ("init", NodeError, "LookupError: no wires"),
        ("announce", NodeError, "LookupError: no words"),
        ("announces 3", NodeError, "announce(): expected announcements, found 3 (int)"),
        (
            "announces another's",
            NodeError,
            "expected a source that is 'n', below it, or announced by this node, "
            "found Announcement of 'drone', which is drone's",
        ),
        ("on_announcement", NodeError, "LookupError: no ears"),
        ("refuses", RefusedError, "cannot work with drone/imu: too loud"),
        ("check", NodeError, "LookupError: no eyes"),
        ("lacks", RefusedError, "a rope is missing; so is a hook"),
    ],
)
def test_each_phase_of_the_start_fails_with_the_nodes_name(
    fails: str, kind: type[NodeError], text: str
) -> None:
    with pytest.raises(NodeError) as caught:
        run_nodes([spec(Drone, "drone"), spec(Fails, "n", {"fails": fails})], duration=0.1)
    assert type(caught.value) is kind
    assert str(caught.value) == f"n: {text}"


def test_a_run_that_is_cancelled_while_a_node_shuts_down_is_cancelled() -> None:
    """And no error of the node."""
    ended = []

    async def linger() -> None:
        try:
            await asyncio.sleep(99)
        finally:
            ended.append(True)

    async def main() -> None:
        runner = NodeRunner(
            spec(Drone, "n"),
            lambda coro, name: asyncio.get_running_loop().create_task(coro, name=name),
        )
        step = asyncio.create_task(runner._last_step(100.0, "on_shutdown", linger()))
        await asyncio.sleep(1)
        assert not ended
        step.cancel()
        with pytest.raises(asyncio.CancelledError):
            await step
        assert ended == [True]

    run_in_lockstep(main())
