"""Small events for tests, and a host that gives nodes no more than they need to be made."""

from __future__ import annotations

from typing import Any, TypeVar

from events import Event
from runtime.host import Host
from runtime.node import Node, NodeConfig, make_node
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.time.stepping import Stepping

N = TypeVar("N", bound=Node[Any])
W = TypeVar("W")


class Said(Event):
    """Something was said."""

    text: str = ""


class Shouted(Said):
    """Something was said loudly."""


class Sung(Event):
    """Something was sung."""


def said(text: str = "", source: str = "drone", stamp: int = 0) -> Said:
    return Said(stamp=stamp, source=source, text=text)


def shouted(text: str = "", source: str = "drone") -> Shouted:
    return Shouted(stamp=0, source=source, text=text)


class NoHost(Host):
    """A host for nodes that ask nothing of it."""

    def __init__(self, seed: int = 0) -> None:
        with_loop = LockstepLoop()
        super().__init__(LockstepClock(with_loop), seed)
        self.stepping = Stepping(self.clock)
        with_loop.close()


def make(cls: type[N], name: str = "node", config: NodeConfig | None = None, seed: int = 0) -> N:
    """Make a node as a run would."""
    return make_node(cls, name, config or cls.config_type(), NoHost(seed))
