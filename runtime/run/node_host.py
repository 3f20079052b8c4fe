"""Services of a run for its nodes: tasks, ticks, workers and threads."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import inspect
import logging
from collections.abc import Callable, Container, Coroutine, Mapping
from itertools import chain, count
from pathlib import Path
from typing import Any

from typing_extensions import TypeVar

from runtime.channels.answers import Answers
from runtime.channels.hold import Hold, HoldConfig
from runtime.channels.streams import Stream
from runtime.config.model import Config
from runtime.host import RunEnd, Sibling
from runtime.node import Node
from runtime.run.instruments import Instruments
from runtime.run.node_runner import Create, NodeRunner
from runtime.run.run_state import ParameterServer, RunState
from runtime.time.schedule import Tick, Ticker
from runtime.time.stepping import Stepping
from runtime.workers.costs import Costs
from runtime.workers.worker import Worker

W = TypeVar("W")

log = logging.getLogger("visnav.runtime")


class NodeHost:
    """The `Host` of a run's nodes."""

    checking = False

    def __init__(
        self,
        state: RunState,
        out: Path | None,
        out_of_programs: Path | None,
        instruments: Instruments,
        parameters: ParameterServer,
        create: Create,
        stop: Callable[[str, str], None],
        fault: Callable[[str, BaseException], None],
    ) -> None:
        self.state = state
        self.out = out
        self.out_of_programs = out_of_programs
        self.seed = state.config.run.seed
        self.clock = state.clock
        self.siblings = siblings(state.config, state.runners)
        self.shared: dict[str, Any] = {}
        self.stepping = Stepping(state.clock, over=lambda: bool(state.reason))
        self.instruments = instruments
        self.parameters = parameters
        self._stop = stop
        self._create = create
        self._fault = fault
        self._executor = concurrent.futures.ThreadPoolExecutor(
            max_workers=8, thread_name_prefix="offload"
        )

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
            self._start(node, node.run()).add_done_callback(lambda _: self._has_run(node))

    # What nodes ask for.

    @property
    def run_end(self) -> RunEnd | None:
        """End of the run; `None` before."""
        return self.state.end

    def stop(self, node: Node[Any], reason: str) -> None:
        """End the run in order."""
        self._stop(node.name, reason)

    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine as part of a node."""
        self._start(node, coro)

    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        """Call a function of a node at a rate, from the first update on."""
        runner, tickers = self.state.runners[node.name], self.state.tickers
        full_name = _ticker_name(runner, name)
        if inspect.iscoroutinefunction(call):
            call = self._in_background(node, call, full_name)
        fault = functools.partial(self._fault, node.name)
        ticker = Ticker(full_name, hz, call, fault, before=tickers.get(full_name))
        tickers[full_name] = ticker
        runner.tickers.append(ticker)
        self.instruments.on_ticker(ticker)
        if self.state.running and runner.started:
            self._add(ticker)
        return ticker

    async def worker(
        self, node: Node[Any], factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        """Start a worker, and end the worker with the node."""
        loop = asyncio.get_running_loop()

        def died(error: Exception) -> None:
            loop.call_soon_threadsafe(self._fault, node.name, error)

        name = f"{node.name}.{getattr(factory, '__name__', 'worker')}"
        worker: Worker[W] = Worker(
            name,
            self.clock,
            factory,
            *args,
            printed=lambda line: node.log.debug("%s printed: %s", name, line),
            died=died,
            costs=self.state.costs.setdefault(name, Costs()),
            **options,
        )
        self.state.runners[node.name].workers.append(worker)  # which ends it, ready or not
        await worker.ready()
        self.instruments.on_worker(worker)
        return worker

    def hold(self, node: Node[Any], name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        """Make the hold of an outside system, and end the hold with the node."""
        known = self.state.outside.get(name)
        answers = self.state.outside.setdefault(name, Answers())
        hold: Hold[Any] = Hold(
            name,
            self.clock,
            config,
            latency,
            answers=answers,
            log=node.log.warning,
            wall=self.stepping.real_seconds,
        )
        self.state.runners[node.name].holds.append(hold)
        if known is None:
            self.state.after_run.append(lambda folder: answers.write(folder, name))
        return hold

    def offload(
        self, node: Node[Any], call: functools.partial[Any]
    ) -> concurrent.futures.Future[Any]:
        """Run a function of a node in a thread."""
        return self._executor.submit(self.instruments.offloaded(node.name, call))

    def note_environment(self, name: str, value: str) -> None:
        """Add a property of the run's environment to the summary."""
        self.state.environment[name] = value

    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        """Note a verdict for the summary."""
        found = self.state.flights if flight else self.state.conclusions
        found[subject] = {"passed": passed, **figures}

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Have a function called once the summary is written."""
        self.state.after_run.append(call)

    # How it is done.

    def _start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        runner = self.state.runners[node.name]
        guarded = self._guard(node, coro)
        guarded.__qualname__ = getattr(coro, "__qualname__", guarded.__qualname__)  # type: ignore[attr-defined]
        task = self._create(guarded, node.name)
        runner.tasks[task] = None
        self.instruments.on_task(node.name, task)
        task.add_done_callback(lambda _: runner.tasks.pop(task, None))
        if inspect.iscoroutine(coro):  # which is not begun if the task is cancelled before
            task.add_done_callback(lambda _: coro.close())
        return task

    async def _guard(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        runner = self.state.runners[node.name]
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
        runner = self.state.runners[node.name]
        ports = [*node.declared.inputs, *node.declared.bundles]
        over = self.state.stopped is not None or runner.shutting_down or runner.restarting
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
                self.state.tickers[ticks.name].missed += 1
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
    taken = {ticker.name for ticker in runner.tickers if not ticker.stopped}
    return next(n for n in chain([full], (f"{full}_{i}" for i in count(2))) if n not in taken)
