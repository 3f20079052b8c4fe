"""What a run does for its nodes, and what they may know of one another."""

from __future__ import annotations

import concurrent.futures
import functools
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from typing_extensions import TypeVar

from runtime.clock import Clock
from runtime.hold import Hold, HoldConfig
from runtime.schedule import Tick, Ticker
from runtime.stepping import Stepping
from runtime.workers.worker import Worker

W = TypeVar("W")


class Sibling(NamedTuple):
    """A node of the run, as the file describes it.

    Attributes:
        name: As in the file.
        node: Its class.
        config: Its settings.
        sources: Ports that the file narrows to a source.
        here: Whether it runs in this process.
    """

    name: str
    node: type[Any]
    config: Any
    sources: Mapping[str, str]
    here: bool


class Host(Protocol):
    """What a run does for its nodes; see the methods of `Node` that call these, with themselves.

    Attributes:
        siblings: All nodes of the run, in file order.
        shared: What nodes of this process share, by name.
        stepping: Pauses and steps simulated time.
    """

    seed: int
    clock: Clock
    out: Path | None
    checking: bool
    siblings: tuple[Sibling, ...]
    shared: dict[str, Any]
    stepping: Stepping

    def start(self, node: Any, coro: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine as part of a node."""

    def every(self, node: Any, hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        """Call a function of a node at a rate."""

    async def worker(
        self, node: Any, factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        """Make a worker that ends with the node."""

    def hold(self, node: Any, name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        """Make the hold of an outside system, which ends with the node."""

    def offload(self, node: Any, call: functools.partial[Any]) -> concurrent.futures.Future[Any]:
        """Run a function of a node in a thread."""

    @property
    def stop(self) -> Callable[[str], None]:
        """Ends the run in order, for a reason."""

    def conclude(self, subject: str, figures: Mapping[str, Any], passed: bool | None) -> None:
        """Put a verdict into the summary."""

    def note_environment(self, name: str, value: str) -> None:
        """Put what the run depends on into the summary."""

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Call a function once the summary is written."""
