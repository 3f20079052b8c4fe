"""What is known of a run while it goes on: written by its supervisor, read by observers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from events import Announcement
from runtime.channels.answers import Answers
from runtime.channels.links import Link
from runtime.config.model import Config
from runtime.host import RunEnd
from runtime.node import Node
from runtime.run.node_runner import NodeRunner
from runtime.time.clock import Clock
from runtime.time.schedule import SECOND, Ticker
from runtime.workers.costs import Costs

SHUTDOWN_SHARE = 0.05
"""Share of a run's length, on the longer of the clock and real time, by which `shutdown_limit`
grows: what a node has to finish grows with it."""


@dataclass
class RunState:
    """One run in this process.

    Attributes:
        config: What runs.
        clock: The run's clock.
        runners: The nodes that run in this process, by name, in file order.
        several_processes: Whether other nodes of the file run in other processes.
        running: Whether the first update has been, and nodes may send.
        first_update: When that was, on `time.monotonic`; `None` before.
        stop_requested: Why the end of the run was requested, such as by a signal; the loop may
            not know of it yet.
        stopped: When the end of the run was asked for, on `time.monotonic`; `None` before.
        stopped_at: The same on the run's clock (ns).
        reason: Why the run ends; "" before.
        end: How the run ended; `None` before.
        error: The first that went wrong, if anything did.
        interruption: An exception that is to be raised in a node that blocks the loop.
        announcements: What the nodes announced.
        truth_readers: As in `RunEnd`.
        all_nodes: All nodes there have been, those restarted or dropped included.
        tickers: By ``node.method``.
        links: All links of the nodes that there are, by ``node.port``.
        conclusions: What nodes concluded, by what they judged.
        environment: What nodes found of the machine on which figures depend.
        costs: What workers cost, by ``node.Factory``.
        outside: What became of the frames for systems outside the process, by their names.
        before_first_update: What is called once all nodes have started.
        after_run: What is called with the run's folder at the very end.
    """

    config: Config
    clock: Clock
    runners: dict[str, NodeRunner]
    several_processes: bool = False
    running: bool = False
    first_update: float | None = None
    stop_requested: str = ""
    stopped: float | None = None
    stopped_at: int | None = None
    reason: str = ""
    end: RunEnd | None = None
    error: Exception | None = None
    interruption: Exception | None = None
    announcements: list[Announcement] = field(default_factory=list)
    truth_readers: set[str] = field(default_factory=set)
    all_nodes: list[Node[Any]] = field(default_factory=list)
    tickers: dict[str, Ticker] = field(default_factory=dict)
    links: dict[str, Link] = field(default_factory=dict)
    conclusions: dict[str, dict[str, Any]] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    costs: dict[str, Costs] = field(default_factory=dict)
    outside: dict[str, Answers] = field(default_factory=dict)
    before_first_update: Callable[[], None] = lambda: None
    after_run: list[Callable[[Path], Any]] = field(default_factory=list)

    def note_error(self, error: Exception) -> None:
        """Note that something went wrong; the first error counts."""
        self.error = self.error or error

    def shutdown_limit(self) -> float:
        """Return how many real seconds a node may take now to shut down."""
        real = time.monotonic() - (self.first_update or time.monotonic())
        length = max(real, self.clock.now() / SECOND)
        return self.config.run.shutdown_limit + SHUTDOWN_SHARE * length
