"""What nodes ask a run for: tasks, ticks, workers, holds, threads, entries of the summary."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import inspect
import logging
from collections.abc import Callable, Container, Coroutine, Mapping
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.channels.streams import Stream
from runtime.config.model import Config
from runtime.host import Host, RunEnd, Sibling
from runtime.logs import executor
from runtime.node import Node
from runtime.run.instruments import Instruments
from runtime.run.node_runner import Create, NodeRunner
from runtime.run.run_state import RunState
from runtime.time.clock import Tick, Ticker
from runtime.time.stepping import Stepping
from runtime.typed import TypeVar, override

if TYPE_CHECKING:
    from runtime.channels.hold import Hold, HoldConfig
    from runtime.workers.worker import Worker

W = TypeVar("W")

log = logging.getLogger("visnav.runtime")


class NodeServices(Host):
    """Services of a run for its nodes.

    Args:
        create: Makes a task that the run owns.
        stop: Called with a node's name and its reason to end the run.
        fault: Called with a node's name and what its tasks, ticks or workers raised.

    Attributes:
        make_worker: Makes workers in the place of their class.
    """

    def __init__(
        self,
        state: RunState,
        instruments: Instruments,
        create: Create,
        stop: Callable[[str, str], None],
        fault: Callable[[str, BaseException], None],
    ) -> None:
        super().__init__(state.clock, state.config.run.seed, siblings(state.config, state.runners))
        self.stepping = Stepping(state.clock, lambda: bool(state.reason))
        self.shutdown_limit = state.config.run.shutdown_limit
        self._state = state
        self._instruments = instruments
        self.make_worker: Callable[..., Worker[Any]] | None = None
        self._create = create
        self._stop = stop
        self._fault = fault
        self._executor = executor("offload", 8)

    @property
    @override
    def run_end(self) -> RunEnd | None:
        return self._state.run_end

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

    # What nodes ask for.

    @override
    def stop(self, node: Node[Any], reason: str) -> None:
        self._stop(node.name, reason)

    @override
    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        runner = self._state.runners[node.name]
        guarded = self._guard(node, coro)
        guarded.__qualname__ = getattr(coro, "__qualname__", guarded.__qualname__)  # type: ignore[attr-defined]
        task = self._create(guarded, node.name)
        runner.tasks[task] = None
        self._instruments.on_task(node.name, task)
        task.add_done_callback(lambda _: runner.tasks.pop(task, None))
        if inspect.iscoroutine(coro):  # which is not begun if the task is cancelled before
            task.add_done_callback(lambda _: coro.close())
        return task

    @override
    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        runner, tickers = self._state.runners[node.name], self._state.tickers
        full_name = _ticker_name(runner, name)
        if inspect.iscoroutinefunction(call):
            call = self._in_background(node, call, full_name)
        fault = functools.partial(self._fault, node.name)
        ticker = Ticker(full_name, hz, call, fault, before=tickers.get(full_name))
        tickers[full_name] = ticker
        runner.tickers.append(ticker)
        self._instruments.on_ticker(ticker)
        if self._state.running and not runner.restarting:  # before, `run_node` does it
            self._add(ticker)
        return ticker

    @override
    async def worker(
        self, node: Node[Any], factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        from runtime.workers.costs import Costs
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
            costs=self._state.costs.setdefault(name, Costs()),
            **options,
        )
        self._state.runners[node.name].workers.append(worker)  # which ends it, ready or not
        await worker.ready()
        self._instruments.on_worker(worker)
        return worker

    @override
    def hold(self, node: Node[Any], name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        from runtime.channels.answers import Answers
        from runtime.channels.hold import Hold

        known = self._state.outside.get(name)
        answers = self._state.outside.setdefault(name, Answers())
        hold: Hold[Any] = Hold(
            name,
            self.clock,
            config,
            latency,
            answers=answers,
            log=node.log.warning,
            wall=self.stepping.real_seconds,
        )
        self._state.runners[node.name].holds.append(hold)
        if known is None:
            self.after_run(lambda folder: answers.write(folder, name))
        return hold

    @override
    def offload(
        self, node: Node[Any], call: functools.partial[Any]
    ) -> concurrent.futures.Future[Any]:
        return self._executor.submit(self._instruments.offloaded(node.name, call))

    @override
    def note_environment(self, name: str, value: str) -> None:
        self._state.environment[name] = value

    @override
    def note_truth(self, subject: str, facts: Mapping[str, Any]) -> None:
        self._state.truth[subject] = dict(facts)

    @override
    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        verdicts = self._state.flights if flight else self._state.conclusions
        verdicts[subject] = {"passed": passed, **figures}

    @override
    def after_run(self, call: Callable[[Path], Any]) -> None:
        self._state.afterwards.append(call)

    # How it is done.

    async def _guard(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        runner = self._state.runners[node.name]
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
        runner = self._state.runners[node.name]
        ports = [*node.declared.inputs, *node.declared.bundles]
        over = self._state.stopped is not None or runner.shutting_down or runner.restarting
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
                self._state.tickers[ticks.name].missed += 1
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
