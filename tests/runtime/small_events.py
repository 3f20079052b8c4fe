"""Small events for tests, and a host that gives nodes no more than they need to be made."""

from __future__ import annotations

import concurrent.futures
import functools
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, TypeVar

from events import Event
from runtime.channels.hold import Hold, HoldConfig
from runtime.host import Sibling
from runtime.node import Node, NodeConfig, make_node
from runtime.time.clock import Clock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.time.schedule import Tick, Ticker
from runtime.time.stepping import Stepping
from runtime.workers.worker import Worker

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


class NoHost:
    """A host for nodes that ask nothing of it."""

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        with_loop = LockstepLoop()
        self.clock: Clock = LockstepClock(with_loop)
        with_loop.close()
        self.out: Path | None = None
        self.out_of_programs: Path | None = None
        self.checking = False
        self.siblings: tuple[Sibling, ...] = ()
        self.shared: dict[str, Any] = {}
        self.run_end = None
        self.stepping = Stepping(self.clock)

    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        raise NotImplementedError

    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        raise NotImplementedError

    async def worker(
        self, node: Node[Any], factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        raise NotImplementedError

    def hold(self, node: Node[Any], name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        return Hold(name, self.clock, config, latency)

    def offload(
        self, node: Node[Any], call: functools.partial[Any]
    ) -> concurrent.futures.Future[Any]:
        raise NotImplementedError

    def stop(self, node: Node[Any], reason: str) -> None:
        raise NotImplementedError

    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        raise NotImplementedError

    def note_environment(self, name: str, value: str) -> None:
        raise NotImplementedError

    def after_run(self, call: Callable[[Path], Any]) -> None:
        raise NotImplementedError


def make(cls: type[N], name: str = "node", config: NodeConfig | None = None, seed: int = 0) -> N:
    """Make a node as a run would."""
    return make_node(cls, name, config or cls.config_type(), NoHost(seed))
