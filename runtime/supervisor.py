"""The life of a run's nodes: started in order, watched over, ended in reverse order.

    construct → on_startup, in file order
    announce, heard by all; check; on_ready, in file order
    connect; ticks and run() begin: the first update
    …
    cancel run(), on_shutdown: in reverse order, always, each with a time limit

The run owns every task, and every wait for one has a limit: a node that does not end is named and
left behind. What an exception in a node does is up to the node's `on_error`.
Not here: loops, signals and files (`runtime.execute`).
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import inspect
import logging
import time
from collections.abc import Callable, Collection, Coroutine, Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import TypeVar

from events import Announcement, Event, Shutdown, WindowClosed
from runtime import code_location, graph
from runtime.clock import Clock
from runtime.config.model import Config
from runtime.errors import FatalError, NodeError, PeerError, VisnavError
from runtime.instruments import Probes
from runtime.links import Link
from runtime.node import Node
from runtime.node_runner import Life, log_error, wrap
from runtime.parameter_server import Changing
from runtime.schedule import SECOND, Once, Tick, Ticker
from runtime.sender import Deliver, Listener, Tap
from runtime.streams import Stream
from runtime.workers.costs import Costs
from runtime.workers.worker import Worker

if TYPE_CHECKING:
    from runtime.peers.peers import Peers

W = TypeVar("W")

log = logging.getLogger("visnav.runtime")

FIRST_BACKOFF = 0.5
LONGEST_BACKOFF = 30.0
"""Seconds of the clock before a restart: doubled from the first at each failure…"""
HEALTHY = 60.0
"""…until a node has run for so many without one."""

LATER = 0.05
"""Of a run's length, on the longer of the clock and real time, by which `shutdown_limit` grows:
what a node has to finish grows with it."""


class Supervisor:
    """Runs the nodes of a configuration on the running loop; the `Host` of its nodes.

    Args:
        config: What to run.
        clock: The run's clock.
        taps: See every event before its listeners do.
        out: Folder for what nodes write, or `None`.
        only: Nodes that run here, if others run in other processes.
    """

    checking = False

    def __init__(
        self,
        config: Config,
        clock: Clock,
        taps: Sequence[Tap] = (),
        out: Path | None = None,
        only: Collection[str] = (),
    ) -> None:
        self.out = out
        self.seed = config.run.seed
        self.clock = clock
        self.executor: concurrent.futures.Executor = concurrent.futures.ThreadPoolExecutor(
            max_workers=8, thread_name_prefix="offload"
        )
        self.announcements: list[Announcement] = []
        self.first_update: float | None = None
        """When the first update was, on `time.monotonic`."""
        self.ended: float | None = None
        """When the end of the run was asked for, on `time.monotonic`."""
        self.ended_at: int | None = None
        """The same on the run's clock (ns)."""
        self.reason = ""
        self.error: Exception | None = None
        self.asked = ""
        """Why somebody asked for the end of the run, whom the loop may not have heard yet."""
        self.interruption: Exception | None = None
        """What is to be raised in a node that blocks the loop."""
        self.ever: list[Node[Any]] = []
        """All nodes there have been, those restarted or dropped included."""
        self.tickers: dict[str, Ticker] = {}
        self.links: dict[str, Link] = {}
        """All links of the nodes that there are, by ``node.port``."""
        self.verdicts: dict[str, dict[str, Any]] = {}
        """What nodes concluded, by what they judged."""
        self.costs: dict[str, Costs] = {}
        """What workers cost, by ``node.Factory``."""
        self.after: list[Callable[[Path], Any]] = []
        """What is to be called with the run's folder at the very end."""
        self.probes = Probes(self)
        self.changing = Changing(self)
        self._config = config
        self._taps = tuple(taps)
        here = [spec for spec in config.nodes if not only or spec.name in only]
        self._lives = {spec.name: Life(spec, self._own) for spec in here}
        self.peers: Peers | None = None
        """The other processes of the run, if there are any."""
        if len(self._lives) < len(config.nodes):
            from runtime.peers.peers import Peers

            self.peers = Peers(config, only, clock, self)
        self._running = False
        self._ended = asyncio.Event()
        self._begin: asyncio.Task[None] | None = None
        self._tasks: dict[asyncio.Task[Any], None] = {}
        self._recoveries: dict[asyncio.Task[Any], None] = {}

    async def main(self) -> None:
        """Run until something ends the run; `reason` and `error` then say what did."""
        self._begin = self._own(self._start_all(), "start")
        try:
            await self._ended.wait()
            await asyncio.wait([self._begin])
            await self._end_all()
        finally:  # there are none left but those that would not end, unless this was cancelled
            for task in self._tasks:
                task.cancel()
            self.executor.shutdown(wait=False, cancel_futures=True)

    def _own(self, coro: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        """Make a task of the run."""
        task = asyncio.get_running_loop().create_task(coro, name=name)
        self._tasks[task] = None
        task.add_done_callback(lambda _: self._tasks.pop(task, None))
        return task

    # The host of the nodes.

    def stop(self, reason: str, error: Exception | None = None, *, told: bool = False) -> None:
        """End the run in order; the first reason counts.

        Args:
            reason: For the summary.
            error: What went wrong, if anything did.
            told: Whether another process says so, and need not be told.
        """
        if self._ended.is_set():
            return
        reason = self.asked or reason
        if self.peers is not None:
            self.peers.stopping(reason, error, told=told)
        self.reason = reason
        self.error = error
        self.ended, self.ended_at = time.monotonic(), self.clock.now()
        self._ended.set()
        if self._begin is not None and not self._begin.done():
            self._begin.cancel()

    def conclude(self, subject: str, figures: Mapping[str, Any], passed: bool | None) -> None:
        """Note a verdict for the summary."""
        self.verdicts[subject] = {"passed": passed, **figures}

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Have a function called once the summary is written."""
        self.after.append(call)

    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine as part of a node."""
        self._start(node, coro)

    def _start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        life = self._lives[node.name]
        guarded = self._guard(node, coro)
        guarded.__qualname__ = getattr(coro, "__qualname__", guarded.__qualname__)  # type: ignore[attr-defined]
        task = self._own(guarded, node.name)
        life.tasks[task] = None
        self.probes.on_task(node.name, task)
        task.add_done_callback(lambda _: life.tasks.pop(task, None))
        if inspect.iscoroutine(coro):  # which is not begun if the task is cancelled before
            task.add_done_callback(lambda _: coro.close())
        return task

    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        """Call a function of a node at a rate, from the first update on."""
        full_name = self._ticker_name(node.name, name)
        if inspect.iscoroutinefunction(call):
            call = self._in_background(node, call, full_name)
        fault = functools.partial(self.fault, node.name)
        ticker = Ticker(full_name, hz, call, fault, before=self.tickers.get(full_name))
        self.tickers[full_name] = ticker
        self._lives[node.name].tickers.append(ticker)
        self.probes.on_ticker(ticker)
        if self._running and self._lives[node.name].started:
            self._add(ticker)
        return ticker

    async def worker(
        self, node: Node[Any], factory: Callable[..., W], args: tuple[Any, ...], **options: Any
    ) -> Worker[W]:
        """Make a worker that ends with the node."""
        loop = asyncio.get_running_loop()

        def died(error: Exception) -> None:
            loop.call_soon_threadsafe(self.fault, node.name, error)

        name = f"{node.name}.{getattr(factory, '__name__', 'worker')}"
        worker: Worker[W] = Worker(
            name,
            self.clock,
            factory,
            *args,
            printed=lambda line: node.log.debug("%s printed: %s", name, line),
            died=died,
            costs=self.costs.setdefault(name, Costs()),
            **options,
        )
        self._lives[node.name].workers.append(worker)  # which ends it, ready or not
        await worker.ready()
        self.probes.on_worker(worker)
        return worker

    def escaped(self, error: BaseException) -> None:
        """Deal with an exception that came out of the loop: some task or callback let it."""
        name, place = code_location.of_error(error)
        if name in self._lives:
            self.fault(name, error)
            return
        wrapped = wrap("runtime", error)
        log_error(wrapped, last=not self._ended.is_set())
        self.error = self.error or wrapped
        self.stop(f"failed at {place}", wrapped)

    def fault(self, name: str, error: BaseException) -> None:
        """Deal with an exception in a node as its `on_error` says."""
        life = self._lives[name]
        if life.recovering:
            return
        wrapped = wrap(name, error)
        fatal = (
            isinstance(code_location.leaf(error), FatalError)
            or life.spec.on_error == "stop"
            or not self._running
        )
        log_error(wrapped, last=fatal and not self._ended.is_set())
        if self._ended.is_set():
            self.error = self.error or wrapped
        elif fatal:
            self.stop(f"{name} failed", wrapped)
        else:
            self.restart(name)

    def restart(self, name: str, *, anyway: bool = False) -> None:
        """Take a node out, and bring up a new one in its place if its `on_error` wants that.

        Args:
            name: Of the node.
            anyway: Bring one up whatever that says: somebody asked for it.
        """
        life = self._lives[name]
        life.recovering = True
        if self.clock.now() - life.begun > HEALTHY * SECOND:
            life.failures = 0
        task = self._own(self._recover(life, anyway), f"recover {name}")
        self._recoveries[task] = None
        task.add_done_callback(lambda task: self._recoveries.pop(task, None))

    # Beginning.

    async def _start_all(self) -> None:
        try:
            if self.peers is not None:
                before = await self.peers.meet()
                for life in self._lives.values():
                    life.starts = before
            for life in self._lives.values():
                await self._start_up(life)
                if self._ended.is_set():  # it stopped the run and did not wait for anything after
                    return
            said = {name: life.announced() for name, life in self._lives.items()}
            mine = list(chain(*said.values()))
            self.announcements += await self.peers.announce(said) if self.peers else mine
            for life in self._lives.values():
                life.hear(self.announcements)
            for life in self._lives.values():
                await life.ready(self._config.run.startup_limit)
                if self._ended.is_set():
                    return
            if self.peers is not None:
                self.connect()  # so that each knows what the others hear
                await self.peers.begin()
        except PeerError as error:
            log.error("%s", error, extra={"told": True})
            self.stop("the processes of the run did not come together", error)
            return
        except asyncio.CancelledError:  # the run is to end
            raise
        except BaseException as error:
            failed = wrap("runtime", error)
            log_error(failed, last=True)
            self.stop("start-up failed", failed)
            return
        for announcement in mine:
            for tap in self._taps:
                tap(None, announcement)
        self.connect()
        self._running = True
        self.first_update = time.monotonic()
        if self.peers is None:
            self.clock.start()
        if self._config.run.duration:
            end = self.clock.now() + round(self._config.run.duration * 1e9)
            self.clock.schedule.add(end, Once(lambda: self.stop("duration")))
        for index, spec in enumerate(self._config.nodes):
            if spec.name in self._lives:
                self.clock.schedule.order = (index + 1) << 32  # as if all nodes were here
                self._begin_node(self._lives[spec.name])
        if self.peers is not None:
            self.peers.begun()

    async def _start_up(self, life: Life) -> None:
        limit = self._config.run.startup_limit
        try:
            await life.begin(self, limit)
        finally:
            if life.node is not None and life.node not in self.ever:
                self.ever.append(life.node)
            self.links |= {link.name: link for link in life.links.values()}

    def connect(self) -> None:
        """Freeze who hears whom; anew whenever a node or another process comes or goes."""
        nodes = [life.node for life in self._lives.values() if life.node and life.started]
        sources = {node.name: node.sources for node in nodes}
        links = {life.spec.name: life.links for life in self._lives.values()}
        end = Listener("run", self._hear_end, (Shutdown, WindowClosed))
        elsewhere = self.peers.listeners if self.peers is not None else graph.nobody
        heard = self.probes.looking(
            graph.connect(
                nodes, sources, links, self._taps, self._listener_failed, [end], elsewhere
            )
        )
        if self.peers is not None:
            self.peers.connect(heard, self._listener_failed)
        self.changing.connect(heard, self._taps, self._listener_failed)
        self.probes.on_connected(nodes, [self.changing.sender])

    def _begin_node(self, life: Life) -> None:
        node = life.node
        assert node is not None
        life.begun = self.clock.now()
        for ticker in life.tickers:
            self._add(ticker)
        for method, ticks in node.declared.ticks.items():
            hz = getattr(node.config, ticks.hz) if isinstance(ticks.hz, str) else ticks.hz
            self.every(node, hz, getattr(node, method), method)
        if type(node).run is not Node.run:
            self._start(node, node.run()).add_done_callback(lambda _: self._has_run(node))

    def _has_run(self, node: Node[Any]) -> None:
        """Say so if a node has stopped reading its inputs: it looks alive, and is not."""
        life, ports = self._lives[node.name], [*node.declared.inputs, *node.declared.bundles]
        if ports and not (self._ended.is_set() or life.closing or life.recovering):
            unread = ", ".join(ports)
            log.warning("%s: run() has returned: nobody reads %s any more", node.name, unread)

    def _add(self, ticker: Ticker) -> None:
        ticker.begin(self.clock.now())
        self.clock.schedule.add(ticker.due, ticker)

    def _ticker_name(self, node: str, name: str) -> str:
        """Return ``node.name``, with a number if the node has a ticker of this name already."""
        taken = {ticker.name for ticker in self._lives[node].tickers if not ticker.stopped}
        numbered = (f"{node}.{name}_{number}" for number in count(2))
        return next(full for full in chain([f"{node}.{name}"], numbered) if full not in taken)

    def _in_background(
        self, node: Node[Any], call: Callable[[Tick], Any], name: str
    ) -> Callable[[Tick], None]:
        """Return a function that hands ticks to a coroutine, and skips those it is too busy for."""
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

    # Going wrong.

    async def _guard(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:
        life = self._lives[node.name]
        me = asyncio.current_task()
        try:
            await coro
        except BaseException as error:
            ours = life.closing or life.node is not node
            if ours and isinstance(error, asyncio.CancelledError):
                raise
            if asyncio._get_running_loop() is None or asyncio.current_task() is not me:
                raise  # a GeneratorExit: it is thrown away
            if life.node is node:
                self.fault(node.name, error)

    def _listener_failed(self, deliver: Deliver, error: BaseException) -> None:
        owner: Any = deliver.__self__  # type: ignore[attr-defined]  # a node, or a stream of one
        self.fault(owner.name.partition(".")[0], error)

    def _hear_end(self, event: Event) -> None:
        reason = getattr(event, "reason", "") or type(event).__name__
        self.stop(f"{event.source}: {reason}")

    async def _recover(self, life: Life, anyway: bool) -> None:
        name = life.spec.name
        # Shielded: the end of the run ends this task, but must not cut an on_shutdown short.
        await asyncio.shield(self._own(self._retire(life), name))
        if life.spec.on_error == "drop" and not anyway:
            log.warning("%s: left out from here on", name)
            return
        while not self._ended.is_set():
            pause = min(FIRST_BACKOFF * 2 ** min(life.failures, 16), LONGEST_BACKOFF)
            life.failures += 1
            log.warning("%s: restarts in %g s", name, pause)
            await self.clock.sleep(pause)
            try:
                await self._start_up(life)
                life.hear(self.announcements)
                await life.ready(self._config.run.startup_limit)
            except NodeError as error:
                if isinstance(code_location.leaf(error.__cause__ or error), FatalError):
                    log_error(error, last=True)
                    self.stop(f"{name} failed", error)
                    return
                log_error(error, last=False)
                await asyncio.shield(self._own(self._retire(life), name))
                continue
            life.recovering = False
            self.connect()
            self._begin_node(life)
            return

    # Ending.

    async def _end_all(self) -> None:
        for ticker in self.tickers.values():
            ticker.stopped = True
        for task in self._recoveries:
            task.cancel()
        if self._recoveries:
            await asyncio.wait(self._recoveries)
        if not self._running:  # what has started may still send farewells to what has, too
            self.connect()
        for name, life in reversed(self._lives.items()):
            await self._turn_to_end(name)
            await self._retire(life)
            if self.peers is not None:
                self.peers.retired(name)
        await self._turn_to_end("")

    async def _turn_to_end(self, name: str) -> None:
        """Let the nodes after this one end first, in whichever process they are."""
        try:
            if self.peers is not None:
                await self.peers.ending.turn(name)
        except VisnavError as error:
            log.error("%s", error)
            self.error = self.error or error

    async def _retire(self, life: Life) -> None:
        """End one node, unless that is done: it hears nothing afterwards."""
        async with life.ending:
            for error in await life.end(self.shutdown_limit()):
                self.error = self.error or error
            self.connect()

    def shutdown_limit(self) -> float:
        """Return how many real seconds a node's end may take now."""
        real = time.monotonic() - (self.first_update or time.monotonic())
        length = max(real, self.clock.now() / SECOND)
        return self._config.run.shutdown_limit + LATER * length
