"""State of a run in progress, and changes of its nodes' settings.

The supervisor writes the state, observers read it. Which settings may change is decided in
`runtime.config.parameters`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from events import Announcement, ParameterChanged
from runtime.channels.answers import Answers
from runtime.channels.links import Link
from runtime.channels.sender import Listener, Sender, Tap
from runtime.channels.tasks import Fault
from runtime.config.model import Config
from runtime.config.parameters import change
from runtime.errors import ConfigError
from runtime.host import RunEnd
from runtime.node import Node
from runtime.run.node_runner import NodeRunner
from runtime.time.clock import Clock
from runtime.time.schedule import SECOND, Ticker
from runtime.workers.costs import Costs

SHUTDOWN_SHARE = 0.05
"""Share of a run's length (clock's or real time, if longer) in `shutdown_limit`."""


@dataclass
class RunState:
    """State of a run in this process.

    Attributes:
        runners: The nodes that run in this process, by name, in file order.
        running: Whether the first update has been, and nodes may send.
        first_update: When that was, on `time.monotonic`; `None` before.
        stop_requested: Why the end of the run was requested, such as by a signal; the loop may not
            know of it yet.
        stopped: When the end of the run was asked for, on `time.monotonic`; `None` before.
        interruption: An exception that is to be raised in a node that blocks the loop.
        all_nodes: All nodes there have been, those restarted or dropped included.
        links: All links of the nodes that there are, by ``node.port``.
        environment: What nodes found of the machine on which figures depend.
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
    flights: dict[str, dict[str, Any]] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    costs: dict[str, Costs] = field(default_factory=dict)
    outside: dict[str, Answers] = field(default_factory=dict)
    before_first_update: Callable[[], None] = lambda: None
    after_run: list[Callable[[Path], Any]] = field(default_factory=list)

    def note_error(self, error: Exception) -> None:
        """Record an error; the first becomes the error of the run."""
        self.error = self.error or error

    def shutdown_limit(self) -> float:
        """Return how many real seconds a node may take now to shut down."""
        real = time.monotonic() - (self.first_update or time.monotonic())
        length = max(real, self.clock.now() / SECOND)
        return self.config.run.shutdown_limit + SHUTDOWN_SHARE * length


log = logging.getLogger("visnav.runtime")


class ParameterServer:
    """Changes settings of a run's nodes, and sends an event for each."""

    def __init__(self, state: RunState, fault: Callable[[str, BaseException], None]) -> None:
        self._state = state
        self._fault = fault
        self._sender = Sender("run.parameters", ParameterChanged)
        self._early: list[ParameterChanged] = []  # of changes before the first update

    def connect(self, listeners: Iterable[Listener], taps: Iterable[Tap], fault: Fault) -> None:
        """Connect all capable listeners to changes, also those of the changed node."""
        self._sender.connect(listeners, taps, fault)

    def set(self, text: str) -> dict[str, str]:
        """Change a setting (``node.key=value``) between two steps; return new values by key.

        Raises:
            ConfigError: It cannot be: the message says why, and all is as it was.
        """
        runners = self._state.runners
        name, config, values = change(
            {n: (runner.node or runner.spec).config for n, runner in runners.items()}, text
        )
        if not values:
            return {}
        runner = runners[name]
        if runner.node is None or not runner.started:
            raise ConfigError(f"{text}: expected a node that runs, and {name} does not just now")
        before = runner.node.config
        runner.node.config = config
        try:
            runner.node.on_change(before)
        except ValueError as error:
            runner.node.config = before
            raise ConfigError(f"{text}: {name} refuses: {error}") from None
        except BaseException as error:
            self._fault(name, error)
        runner.spec = msgspec.structs.replace(runner.spec, config=config)  # for when it restarts
        for key, value in values.items():
            log.info("%s.%s is now %s", name, key, value)
            now = self._state.clock.now()
            changed = ParameterChanged(stamp=now, source=name, key=key, value=value)
            if self._state.running:
                self._sender.send(changed)
            else:
                self._early.append(changed)
        return values

    def begin(self) -> None:
        """Send the events of changes made while the nodes were starting."""
        early, self._early = self._early, []
        for changed in early:
            self._sender.send(changed)
