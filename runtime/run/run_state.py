"""State of a run in progress, its services for nodes, and hooks for observing it (instruments).

The supervisor writes the state, observers read it, nodes ask for tasks, ticks, workers and threads.
Which settings may change is decided in `runtime.config.parameters`.

Attaching an instrument connects the run anew and replaces the functions that tickers and coroutines
call; detaching restores them. A run without instruments does not even ask for them. For instruments
see `runtime.tools.tracing` and `runtime.tools.monitor`. The idea is trio's
(https://trio.readthedocs.io, Instrument API).
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import inspect
import logging
import time
from collections.abc import Callable, Container, Coroutine, Mapping
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from events import Announcement, EstimatorAnnouncement, ParameterChanged
from runtime.channels.answers import Answers
from runtime.channels.links import Link
from runtime.channels.sender import Sender
from runtime.channels.streams import Stream
from runtime.config.model import Config
from runtime.errors import ConfigError
from runtime.host import Host, Sibling
from runtime.logs import executor
from runtime.node import Node
from runtime.run import graph
from runtime.run.instruments import Instruments
from runtime.run.node_runner import Create, NodeRunner
from runtime.time.clock import SECOND, Clock, Tick, Ticker
from runtime.time.stepping import Stepping
from runtime.typed import TypeVar, override
from runtime.workers.costs import Costs

if TYPE_CHECKING:
    from runtime.channels.hold import Hold, HoldConfig
    from runtime.workers.worker import Worker


W = TypeVar("W")

log = logging.getLogger("visnav.runtime")

SHUTDOWN_SHARE = 0.05
"""Share of a run's length (clock's or real time, if longer) in `shutdown_limit`."""


class RunState(Host):
    """State of a run in this process, and its services for nodes.

    Attributes:
        runners: The nodes that run in this process, by name, in file order.
        running: Whether the first update has been, and nodes may send.
        first_update: When that was, on `time.monotonic`; `None` before.
        stop_requested: Why the end of the run was requested, such as by a signal; the loop may not
            know of it yet.
        truth_receivers: Nodes that have received true poses, whatever for.
        sensors_read: Cameras and lidars read by each node; see `graph.sensors_read`.
        owners: Nodes by the sources that they announced.
        stopped: When the end of the run was asked for, on `time.monotonic`; `None` before.
        interruption: An exception that is to be raised in a node that blocks the loop.
        all_nodes: All nodes there have been, those restarted or dropped included.
        links: All links of the nodes that there are, by ``node.port``.
        environment: What nodes found of the machine on which figures depend.
        code: Hash of the files of each node that may estimate.
        truth: What nodes announced otherwise than it is, by subject, for the summary alone.
        afterwards: Functions to call once the summary is written.
        make_worker: Makes workers in the place of their class.
        changes: Output for changes of settings; its listeners include the changed node.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        runners: dict[str, NodeRunner],
        instruments: Instruments,
        create: Create,
        stop: Callable[[str, str], None],
        fault: Callable[[str, BaseException], None],
    ) -> None:
        super().__init__(clock, config.run.seed, siblings(config, runners))
        self.stepping = Stepping(clock, lambda: bool(self.reason))
        self.config = config
        self.runners = runners
        self.instruments = instruments
        self.running = False
        self.first_update: float | None = None
        self.stop_requested = ""
        self.stopped: float | None = None
        self.stopped_at: int | None = None
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
        self.make_worker: Callable[..., Worker[Any]] | None = None
        self.before_first_update: Callable[[], None] = lambda: None
        self.afterwards: list[Callable[[Path], Any]] = []
        self.changes = Sender("run.parameters", ParameterChanged)
        self._early: list[ParameterChanged] = []  # of changes before the first update
        self._create = create
        self._stop = stop
        self._fault = fault
        self._executor = executor("offload", 8)

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

    def close(self) -> None:
        """Start no more threads, and wait for none."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def run_node(self, runner: NodeRunner) -> None:
        """Begin a node's ticks and its `run`: the first update."""
        node = runner.node
        assert node is not None
        runner.running_since = self.clock.now()
        for ticker in runner.tickers:
            self._add(ticker)
        for method, ticks in node.declared.ticks.items():
            hz = getattr(node.config, ticks.hz) if isinstance(ticks.hz, str) else ticks.hz
            self.every(node, hz, getattr(node, method), method)
        if type(node).run is not Node.run:
            self.start(node, node.run()).add_done_callback(lambda _: self._has_run(node))

    def set_parameter(self, text: str) -> dict[str, str]:
        """Change a setting (``node.key=value``) between two steps; return new values by key.

        Raises:
            ConfigError: It cannot be: the message says why, and all is as it was.
        """
        from runtime.config.parameters import change

        runners = self.runners
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
            now = self.clock.now()
            changed = ParameterChanged(stamp=now, source=name, key=key, value=value)
            if self.running:
                self.changes.send(changed)
            else:
                self._early.append(changed)
        return values

    def send_early_changes(self) -> None:
        """Send the events of changes made while the nodes were starting."""
        early, self._early = self._early, []
        for changed in early:
            self.changes.send(changed)

    # What nodes ask for.

    @override
    def stop(self, node: Node[Any], reason: str) -> None:
        self._stop(node.name, reason)

    @override
    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        runner = self.runners[node.name]
        guarded = self._guard(node, coro)
        guarded.__qualname__ = getattr(coro, "__qualname__", guarded.__qualname__)  # type: ignore[attr-defined]
        task = self._create(guarded, node.name)
        runner.tasks[task] = None
        self.instruments.on_task(node.name, task)
        task.add_done_callback(lambda _: runner.tasks.pop(task, None))
        if inspect.iscoroutine(coro):  # which is not begun if the task is cancelled before
            task.add_done_callback(lambda _: coro.close())
        return task

    @override
    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        runner, tickers = self.runners[node.name], self.tickers
        full_name = _ticker_name(runner, name)
        if inspect.iscoroutinefunction(call):
            call = self._in_background(node, call, full_name)
        fault = functools.partial(self._fault, node.name)
        ticker = Ticker(full_name, hz, call, fault, before=tickers.get(full_name))
        tickers[full_name] = ticker
        runner.tickers.append(ticker)
        self.instruments.on_ticker(ticker)
        if self.running and not runner.restarting:  # before, `run_node` does it
            self._add(ticker)
        return ticker

    @override
    async def worker(
        self, node: Node[Any], factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        from runtime.workers.worker import Worker

        loop = asyncio.get_running_loop()

        def died(error: Exception) -> None:
            loop.call_soon_threadsafe(self._fault, node.name, error)

        kind = getattr(factory, "__name__", "worker")
        name = f"{node.name}.{kind}"
        worker: Worker[W] = (self.make_worker or Worker)(
            name,
            self.clock,
            factory,
            *args,
            printed=lambda line: node.log.info("%s: %s", kind, line),
            died=died,
            costs=self.costs.setdefault(name, Costs()),
            **options,
        )
        self.runners[node.name].workers.append(worker)  # which ends it, ready or not
        await worker.ready()
        self.instruments.on_worker(worker)
        return worker

    @override
    def hold(self, node: Node[Any], name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        from runtime.channels.hold import Hold

        known = self.outside.get(name)
        answers = self.outside.setdefault(name, Answers())
        hold: Hold[Any] = Hold(
            name,
            self.clock,
            config,
            latency,
            answers=answers,
            log=node.log.warning,
            wall=self.stepping.real_seconds,
        )
        self.runners[node.name].holds.append(hold)
        if known is None:
            self.after_run(lambda folder: answers.write(folder, name))
        return hold

    @override
    def offload(
        self, node: Node[Any], call: functools.partial[Any]
    ) -> concurrent.futures.Future[Any]:
        return self._executor.submit(self.instruments.offloaded(node.name, call))

    @override
    def note_environment(self, name: str, value: str) -> None:
        self.environment[name] = value

    @override
    def note_truth(self, subject: str, facts: Mapping[str, Any]) -> None:
        self.truth[subject] = dict(facts)

    @override
    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        verdicts = self.flights if flight else self.conclusions
        verdicts[subject] = {"passed": passed, **figures}

    @override
    def after_run(self, call: Callable[[Path], Any]) -> None:
        self.afterwards.append(call)

    # How it is done.

    async def _guard(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        runner = self.runners[node.name]
        me = asyncio.current_task()
        try:
            await coro
        except BaseException as error:
            ours = runner.shutting_down or runner.node is not node
            if ours and isinstance(error, asyncio.CancelledError):
                raise
            if asyncio._get_running_loop() is None or asyncio.current_task() is not me:
                raise  # a GeneratorExit: it is thrown away
            if runner.node is node:
                self._fault(node.name, error)

    def _has_run(self, node: Node[Any]) -> None:
        runner = self.runners[node.name]
        ports = [*node.declared.inputs, *node.declared.bundles]
        over = self.stopped is not None or runner.shutting_down or runner.restarting
        if ports and not over:
            unread = ", ".join(ports)
            log.warning("%s: run() has returned: nobody reads %s any more", node.name, unread)

    def _add(self, ticker: Ticker) -> None:
        ticker.begin(self.clock.now())
        self.clock.schedule.add(ticker.due, ticker)

    def _in_background(
        self, node: Node[Any], call: Callable[[Tick], Any], name: str
    ) -> Callable[[Tick], None]:
        """Return a function to hand ticks to a coroutine; ticks are skipped while busy."""
        ticks: Stream[Tick] = Stream(name, bound=1, overflow="drop_oldest")

        async def serve() -> None:
            async for tick in ticks:
                await call(tick)

        def hand_over(tick: Tick) -> None:
            if ticks.waiter is None:
                self.tickers[ticks.name].missed += 1
            else:
                ticks.offer(tick)

        self.start(node, serve())
        return hand_over


def siblings(config: Config, here: Container[str]) -> tuple[Sibling, ...]:
    """Return all nodes of a file as siblings; `here` holds the nodes of this process."""
    return tuple(
        Sibling(spec.name, spec.node, spec.config, spec.inputs, spec.name in here)
        for spec in config.nodes
    )


def _ticker_name(runner: NodeRunner, name: str) -> str:
    full = f"{runner.spec.name}.{name}"
    used = {ticker.name for ticker in runner.tickers if not ticker.stopped}
    return next(n for n in chain([full], (f"{full}_{i}" for i in count(2))) if n not in used)
