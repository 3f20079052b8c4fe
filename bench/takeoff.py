"""What several benchmarks' nodes share: they send the vehicle up."""

from __future__ import annotations

from typing import TypeVar

from events import Takeoff
from runtime import Node, NodeConfig, Output

C = TypeVar("C", bound=NodeConfig)


class TakeoffNode(Node[C]):
    """Base of the nodes that measure a flying vehicle: sends it up when the run begins."""

    commands = Output(Takeoff)

    async def run(self) -> None:
        """Take off."""
        self.commands.send(Takeoff(stamp=self.clock.now(), source=self.name))
