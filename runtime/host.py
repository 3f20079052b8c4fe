"""Services of a run for its nodes, among them pausing and stepping simulated time.

Real time cannot be paused or stepped: sensors and vehicles do not wait. Time stands between two
instants: all that is due up to the instant at which it stands has been done, that instant
included, and all that is due later has not. What happens is therefore the same, in the same order,
in a run that is paused and stepped and in one that is not: they have equal digests.
"""

from __future__ import annotations

import concurrent.futures
import functools
import math
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec

from runtime.time.clock import Clock, Tick, Ticker

if TYPE_CHECKING:
    from runtime.channels.hold import Hold, HoldConfig
    from runtime.time.stepping import Stepping
    from runtime.workers.worker import Worker

W = TypeVar("W")


class Sibling(NamedTuple):
    """A node of the run, as described by the file.

    Attributes:
        sources: Ports that the file narrows to a source.
        here: Whether it runs in this process.
    """

    name: str
    node: type[Any]
    config: Any
    sources: Mapping[str, str]
    here: bool


class RunEnd(msgspec.Struct, frozen=True, kw_only=True):
    """How a run ended.

    Attributes:
        stamp: When its end was asked for, on the run's clock (ns).
        reason: Why, in words.
        by: Who ended it: a node's name, ``user`` (Ctrl-C, a signal, a key, a closed window), or ""
            where its `duration` was over.
        error: Message of the error that ended it, which `by` caused; "" if none did.
        planned: Whether this was the end of the plan: of `duration`, or of what a node that flies
            or replays carries out, without an error; or a person's wish where there is no plan.
        duration: Seconds that the run was to take; `None` if the file does not say.
        restarts: How often each node of this process was brought up anew.
        truth_readers: Nodes of this process that received true poses, but those that fly, and those
            whose `reads_truth` says what for; an estimator in any case.
        truth_relays: Those that received true poses and passed on estimates of programs outside.
        owners: Nodes by the sources that they announced.
        estimators: Nodes that announced an estimator or sent estimates; see
            `Node.relays_estimates`.
        read: Cameras and lidars whose images and scans each of those in this process received.
    """

    stamp: int
    reason: str
    by: str
    error: str = ""
    planned: bool
    duration: float | None = None
    restarts: dict[str, int]
    truth_readers: frozenset[str] = frozenset()
    truth_relays: frozenset[str] = frozenset()
    owners: dict[str, str] = {}
    estimators: frozenset[str] = frozenset()
    read: dict[str, frozenset[str]] = {}


class Host:
    """Services of a run for its nodes, called by the methods of `Node` with themselves.

    Each run of nodes (a run, a check of its file, a test) has its own; here is what all have.
    Without a run there is nothing to end, and no summary: what nodes ask of these is left undone.

    Attributes:
        siblings: All nodes of the run, in file order.
        out: Folder for files of nodes, or `None`; `out_of_programs` of those that start programs.
        shared: Objects shared by nodes of this process, by name.
        stepping: Control of the clock, set by who makes the host.
        shutdown_limit: Real seconds that a node's `on_end` and `on_shutdown` may take at least.
    """

    checking = False
    shutdown_limit = math.inf
    stepping: Stepping

    def __init__(
        self,
        clock: Clock,
        seed: int = 0,
        siblings: tuple[Sibling, ...] = (),
    ) -> None:
        self.clock = clock
        self.seed = seed
        self.siblings = siblings
        self.out: Path | None = None
        self.out_of_programs: Path | None = None
        self.shared: dict[str, Any] = {}

    @property
    def run_end(self) -> RunEnd | None:
        """How the run ended; `None` before."""
        return None

    def start(self, node: Any, coro: Coroutine[Any, Any, None]) -> Any:
        """Run a coroutine as part of a node, and return its task."""
        raise NotImplementedError

    def every(self, node: Any, hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        """Call a function of a node at a rate, from the first update on."""
        raise NotImplementedError

    async def worker(
        self, node: Any, factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        """Start a worker, and end the worker with the node."""
        raise NotImplementedError

    def hold(self, node: Any, name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        """Make the hold of an outside system, and end the hold with the node."""
        raise NotImplementedError

    def offload(self, node: Any, call: functools.partial[Any]) -> concurrent.futures.Future[Any]:
        """Run a function of a node in a thread."""
        raise NotImplementedError

    def stop(self, node: Any, reason: str) -> None:
        """End the run in order, for a reason of a node's."""

    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        """Record a verdict in the summary."""

    def note_environment(self, name: str, value: str) -> None:
        """Record a dependency of the run in the summary."""

    def note_truth(self, subject: str, facts: Mapping[str, Any]) -> None:
        """Record in the summary what is secret during the run."""

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Call a function once the summary is written."""
