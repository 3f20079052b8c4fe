"""State of a run in this process: its nodes, how far it has come, and what goes into its summary.

The supervisor and the services for nodes (`runtime.run.node_services`) write it; watchdogs, the
summary and observers read it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from events import Announcement, EstimatorAnnouncement
from runtime.channels.links import Link
from runtime.config.model import Config
from runtime.host import RunEnd
from runtime.node import Node
from runtime.run import graph
from runtime.run.node_runner import NodeRunner
from runtime.time.clock import SECOND, Clock, Ticker

if TYPE_CHECKING:
    from runtime.channels.answers import Answers
    from runtime.workers.costs import Costs

SHUTDOWN_SHARE = 0.05
"""Share of a run's length (clock's or real time, if longer) in `shutdown_limit`."""


class RunState:
    """State of a run in this process.

    Attributes:
        runners: The nodes that run in this process, by name, in file order.
        running: Whether the first update has been, and nodes may send.
        first_update: When that was, on `time.monotonic`; `None` before.
        stop_requested: Why the end of the run was requested, such as by a signal; the loop may not
            know of it yet.
        stopped: When the end of the run was asked for, on `time.monotonic`; `None` before.
        stopped_at: The same on the run's clock (ns).
        run_end: How the run ended; `None` before.
        interruption: An exception that is to be raised in a node that blocks the loop.
        truth_receivers: Nodes that have received true poses, whatever for.
        sensors_read: Cameras and lidars read by each node; see `graph.sensors_read`.
        owners: Nodes by the sources that they announced.
        all_nodes: All nodes there have been, those restarted or dropped included.
        tickers: The latest ticker of each name.
        links: All links of the nodes that there are, by ``node.port``.
        conclusions: Verdicts by subject; `flights` those about vehicles.
        environment: What nodes found of the machine on which figures depend.
        code: Hash of the files of each node that may estimate.
        truth: What nodes announced otherwise than it is, by subject, for the summary alone.
        costs: Those of workers, by ``node.class``, through all restarts.
        outside: Answers of outside systems, by name, through all restarts.
        afterwards: Functions to call once the summary is written.
    """

    def __init__(self, config: Config, clock: Clock, runners: dict[str, NodeRunner]) -> None:
        self.config = config
        self.clock = clock
        self.runners = runners
        self.running = False
        self.first_update: float | None = None
        self.stop_requested = ""
        self.stopped: float | None = None
        self.stopped_at: int | None = None
        self.run_end: RunEnd | None = None
        self.reason = ""
        self.error: Exception | None = None
        self.interruption: Exception | None = None
        self.announcements: list[Announcement] = []
        self.truth_receivers: set[str] = set()
        self.sensors_read: dict[str, set[str]] = {}
        self.owners: dict[str, str] = {}
        self.all_nodes: list[Node[Any]] = []
        self.tickers: dict[str, Ticker] = {}
        self.links: dict[str, Link] = {}
        self.conclusions: dict[str, dict[str, Any]] = {}
        self.flights: dict[str, dict[str, Any]] = {}
        self.environment: dict[str, str] = {}
        self.code: dict[str, str] = {}
        self.truth: dict[str, dict[str, Any]] = {}
        self.costs: dict[str, Costs] = {}
        self.outside: dict[str, Answers] = {}
        self.afterwards: list[Callable[[Path], Any]] = []

    @property
    def several_processes(self) -> bool:
        """Whether other nodes of the file run in other processes."""
        return len(self.runners) < len(self.config.nodes)

    def estimators(self) -> set[str]:
        """Return the nodes that have announced an estimator or sent estimates of their own."""
        estimating = {
            self.owners.get(announcement.source, "")
            for announcement in self.announcements
            if isinstance(announcement, EstimatorAnnouncement)
        } | {node.name for node in self.all_nodes if graph.sends_estimates(node)}
        classes = {spec.name: spec.node for spec in self.config.nodes}
        return {name for name in estimating & classes.keys() if not graph.relays(classes[name])}

    def truth_readers(self) -> set[str]:
        """Return the nodes that received true poses for no declared use, and all estimators."""
        declared = {s.name for s in self.config.nodes if s.node.flies or s.node.reads_truth}
        return self.truth_receivers - (declared - self.estimators())

    def record_error(self, error: Exception) -> None:
        """Record an error; the first becomes the error of the run."""
        self.error = self.error or error

    def shutdown_limit(self) -> float:
        """Return how many real seconds a node may take now to shut down."""
        real = time.monotonic() - (self.first_update or time.monotonic())
        length = max(real, self.clock.now() / SECOND)
        return self.config.run.shutdown_limit + SHUTDOWN_SHARE * length
