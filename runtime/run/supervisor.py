"""The life of a run's nodes: started in order, watched over, ended in reverse order.

    construct → on_startup, in file order
    announce, received by all; check; on_ready, in file order
    connect; ticks and run() begin: the first update
    …
    on_end, in file order; cancel run(), on_shutdown, in reverse order: always, with time limits

The run owns every task, and every wait for one has a limit: a node that does not end is named and
left behind. What an exception in a node does is up to the node's `on_error`.
Not here: loops, signals and files (`runtime.run.execute`).
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Coroutine, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from events import Announcement, EstimatorAnnouncement, Event, Shutdown, WindowClosed
from runtime.channels.sender import Deliver, Listener, Tap
from runtime.channels.sources import SourceOwners
from runtime.config.model import Config
from runtime.errors import FatalError, NodeError, PeerError, VisnavError
from runtime.host import RunEnd
from runtime.run import event_loop, graph
from runtime.run.event_loop import RunTask
from runtime.run.instruments import Instruments
from runtime.run.node_runner import Announced, NodeRunner, Phase, log_error, start_up, wrap
from runtime.run.node_services import NodeServices
from runtime.run.others import Others
from runtime.run.parameters import Parameters
from runtime.run.run_state import RunState
from runtime.time.clock import SECOND, Clock, Once

log = logging.getLogger("visnav.runtime")

FIRST_BACKOFF = 0.5
"""Seconds of the clock before the first restart of a node; doubled at each failure."""

LONGEST_BACKOFF = 30.0  # seconds of the clock before a restart at most
HEALTHY = 60.0  # seconds of the clock without failure until a node's failures are forgotten


class Supervisor:
    """Runs the nodes of a configuration on the running loop.

    Args:
        out: Folder for what nodes write, or `None`.
        out_of_programs: That for nodes that start programs, if it is another one.
        only: Nodes that run here, if others run in other processes.
        scripted: Nodes that may send in any name: scripts of tests.

    Attributes:
        before_first_update: Called once all nodes are ready; what it raises ends the run.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        taps: Sequence[Tap] = (),
        out: Path | None = None,
        only: Collection[str] = (),
        out_of_programs: Path | None = None,
        scripted: Collection[str] = (),
    ) -> None:
        here = [spec for spec in config.nodes if not only or spec.name in only]
        runners = {spec.name: NodeRunner(spec, self._create_task) for spec in here}
        self.instruments = Instruments(runners, self._reconnect)
        self.state = RunState(config, clock, runners)
        self.parameters = Parameters(self.state, self.fault)
        self.services = NodeServices(
            self.state,
            self.instruments,
            self._create_task,
            lambda node, reason: self.stop(reason, by=node),
            self.fault,
        )
        self.services.out, self.services.out_of_programs = out, out_of_programs or out
        self.stepping = self.services.stepping
        self.before_first_update: Callable[[], None] = lambda: None
        self._taps = tuple(taps)
        self._owners = SourceOwners([spec.name for spec in config.nodes], scripted)
        self.others = Others(clock)
        if self.state.several_processes:
            from runtime.extras import PROCESSES, extension

            peers = extension(PROCESSES, "Peers")
            self.others = peers(config, only, clock, self.stop, self.connect)
        self._ended = asyncio.Event()
        self._startup: asyncio.Task[None] | None = None
        self._tasks: dict[asyncio.Task[Any], None] = {}
        self._restarts: dict[asyncio.Task[Any], None] = {}

    async def main(self) -> None:
        """Run to the end of the run; its cause is in the state's `reason` and `error`."""
        self._startup = self._create_task(self._start_all(), "start")
        try:
            await self._ended.wait()
            await asyncio.wait([self._startup])
            await self._end_all()
        finally:  # there are none left but those that would not end, unless this was cancelled
            for task in self._tasks:
                task.cancel()
            self.services.close()

    def _create_task(self, coro: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(coro, name=name)
        if isinstance(task, RunTask):
            task.protected = True
        self._tasks[task] = None
        task.add_done_callback(lambda _: self._tasks.pop(task, None))
        return task

    # What others ask of a run.

    def stop(
        self,
        reason: str,
        error: Exception | None = None,
        *,
        by: str = "user",
        from_peer: bool = False,
    ) -> None:
        """End the run in order; the first reason counts.

        Args:
            by: Who ends it, as in `RunEnd`.
            from_peer: Whether another process reported it, and need not be notified.
        """
        if self._ended.is_set():
            return
        state = self.state
        if state.stop_requested:
            reason, by = state.stop_requested, "user"
        by = "user" if error is None and self._ends_run(by) == "hand" else by
        self.others.stopping(reason, error, by=by, from_peer=from_peer)
        state.reason = reason
        state.error = error
        state.stopped, state.stopped_at = time.monotonic(), state.clock.now()
        estimators = state.estimators()
        state.run_end = RunEnd(
            stamp=state.stopped_at,
            reason=reason,
            by=by,
            error="" if error is None else str(error),
            planned=error is None and self._is_planned(by),
            duration=state.config.run.duration or None,
            restarts={name: max(runner.starts - 1, 0) for name, runner in state.runners.items()},
            truth_readers=frozenset(state.truth_readers()),
            truth_relays=frozenset(self._truth_relays()),
            owners=dict(state.owners),
            estimators=frozenset(estimators),
            read={n: frozenset(s) for n, s in state.sensors_read.items() if n in estimators},
        )
        if error is not None or state.stop_requested:
            state.clock.hurry()
        self._ended.set()
        if self._startup is not None and not self._startup.done():
            self._startup.cancel()

    def _is_planned(self, by: str) -> bool:
        """Return whether an end by `by`, without an error, completes the run's plan."""
        if by != "user":
            return not by or self._ends_run(by) == "plan"
        config = self.state.config  # no simulator alone has a plan
        return not config.run.duration and all(n.node.ends_run != "plan" for n in config.nodes)

    def _ends_run(self, name: str) -> str:
        """Return the purpose fulfilled if a node ends the run; see `Node.ends_run`."""
        nodes = {spec.name: spec.node for spec in self.state.config.nodes}
        if name not in nodes or name in self.state.estimators():
            return ""
        return nodes[name].ends_run or ("plan" if nodes[name].flies else "")

    def _truth_relays(self) -> set[str]:
        """Return the nodes that received the truth and pass on estimates of others."""
        state = self.state
        speaking = {node.name for node in state.all_nodes if graph.sends_estimates(node)}
        for announcement in state.announcements:
            if isinstance(announcement, EstimatorAnnouncement):
                speaking.add(state.owners.get(announcement.source, ""))
        relays = {spec.name for spec in state.config.nodes if graph.relays(spec.node)}
        return state.truth_receivers & speaking & relays

    def escaped(self, error: BaseException) -> None:
        """Handle an exception raised out of the loop by a task or callback."""
        name, place = event_loop.of_error(error)
        if name in self.state.runners:
            self.fault(name, error)
            return
        wrapped = wrap("runtime", error)
        log_error(wrapped, last=not self._ended.is_set())
        self.state.record_error(wrapped)
        self.stop(f"failed at {place}", wrapped, by="runtime")

    def fault(self, name: str, error: BaseException) -> None:
        """Deal with an exception in a node as its `on_error` says."""
        runner = self.state.runners[name]
        if runner.restarting:
            return
        wrapped = wrap(name, error)
        fatal = (
            isinstance(event_loop.leaf(error), FatalError)
            or runner.spec.on_error == "stop"
            or not self.state.running
        )
        log_error(wrapped, last=fatal and not self._ended.is_set())
        if self._ended.is_set():
            self.state.record_error(wrapped)
        elif fatal:
            self.stop(f"{name} failed", wrapped, by=name)
        else:
            self.restart(name)

    def restart(self, name: str, *, anyway: bool = False) -> None:
        """Shut a node down, and start a new instance if its `on_error` says so, or `anyway`."""
        runner = self.state.runners[name]
        runner.restarting = True
        if self.state.clock.now() - runner.running_since > HEALTHY * SECOND:
            runner.failures = 0
        task = self._create_task(self._restart(runner, anyway), f"restart {name}")
        self._restarts[task] = None
        task.add_done_callback(lambda task: self._restarts.pop(task, None))

    def connect(self) -> None:
        """Freeze each output's listeners; anew whenever a node or another process comes or goes."""
        runners = self.state.runners.values()
        nodes = [runner.node for runner in runners if runner.node and runner.started]
        taps = (*self._taps, *self.instruments.taps)
        listeners = graph.connect(
            nodes,
            links={runner.spec.name: runner.links for runner in runners},
            taps=taps,
            fault=self._listener_failed,
            last=[Listener("run", self._receive_end, (Shutdown, WindowClosed))],
            elsewhere=self.others.listeners,
            wrap=self.instruments.listener,
            owners=self._owners,
            deaf={runner.spec.name for runner in runners if runner.shutting_down},
        )
        self._record_inputs(listeners)
        self.others.connect(listeners, self._listener_failed)
        self.parameters.connect(listeners, taps, self._listener_failed)

    def _record_inputs(self, listeners: list[Listener]) -> None:
        """Record the receivers of true poses, images and scans, also of restarted nodes."""
        state = self.state
        for announcement in state.announcements:
            if owner := self._owners.owner(announcement.source):
                state.owners[announcement.source] = owner
        state.truth_receivers |= graph.truth_receivers(listeners, state.announcements)
        for node, sources in graph.sensors_read(listeners, state.announcements).items():
            state.sensors_read.setdefault(node, set()).update(sources)

    def _reconnect(self) -> None:
        if self.state.running:  # before, nodes must not be able to send
            self.connect()

    def _listener_failed(self, deliver: Deliver, error: BaseException) -> None:
        owner: Any = deliver.__self__  # type: ignore[attr-defined]  # a node, or a stream of one
        self.fault(owner.name.partition(".")[0], error)

    def _receive_end(self, event: Event) -> None:
        reason = getattr(event, "reason", "") or type(event).__name__
        by = self._owners.owner(event.source) or event.source
        self.stop(f"{event.source}: {reason}", by=by)

    # Starting.

    async def _start_all(self) -> None:
        state = self.state
        try:
            announced = await self._start_nodes()
            self.before_first_update()
        except PeerError as error:
            log.error("%s", error, extra={"reported": True})
            self.stop("the processes of the run did not come together", error, by="runtime")
            return
        except asyncio.CancelledError:  # the run is to end
            raise
        except BaseException as error:
            failed = wrap("runtime", error)
            log_error(failed, last=True)
            self.stop("start-up failed", failed, by=failed.node)
            return
        for announcement in announced:
            for tap in self._taps:
                tap(None, announcement)
        self.connect()
        readers = state.truth_readers()
        for announcement in state.announcements:
            node = self._owners.owner(announcement.source)
            undeclared = (
                isinstance(announcement, EstimatorAnnouncement)
                and "truth" not in announcement.reads
            )
            if undeclared and node in readers:
                log.warning("%s: receives true poses, and does not announce so", node)
        state.running = True
        state.first_update = time.monotonic()
        self.others.start_clock()
        if state.config.run.duration:
            end = state.clock.now() + round(state.config.run.duration * SECOND)
            state.clock.schedule.add(end, Once(lambda: self.stop("duration", by="")))
        for index, spec in enumerate(state.config.nodes):
            if spec.name in state.runners:
                state.clock.schedule.order = (index + 1) << 32  # as if all nodes were here
                self.services.run_node(state.runners[spec.name])
        self.parameters.send_early()
        self.others.nodes_run()

    async def _start_nodes(self) -> list[Announcement]:
        """Bring the nodes here to where their first update is next; return their announcements."""
        mine: list[Announcement] = []

        async def start(runner: NodeRunner) -> None:
            await self._start_node(runner)
            self._check_wanted()

        async def exchange(announced: Announced) -> list[Announcement]:
            mine.extend(chain(*announced.values()))
            self.state.announcements += await self.others.announce(announced)
            return self.state.announcements

        async def ready(runner: NodeRunner) -> None:
            await runner.get_ready(self.state.config.run.startup_limit)
            self._check_wanted()

        runners = self.state.runners.values()
        before = await self.others.meet()
        for runner in runners:
            runner.starts = before
        await start_up(
            runners,
            start=start,
            exchange=exchange,
            ready=ready,
            failed=_give_up,
            owners=self._owners,
            limit=self.state.config.run.startup_limit,
        )
        await self.others.begin()
        return mine

    def _check_wanted(self) -> None:
        """End the start-up if a node has stopped the run and did not wait for anything after."""
        if self._ended.is_set():
            raise asyncio.CancelledError

    async def _start_node(self, runner: NodeRunner) -> None:
        state = self.state
        try:
            await runner.start_up(self.services, state.config.run.startup_limit)
        finally:
            if runner.node is not None and runner.node not in state.all_nodes:
                state.all_nodes.append(runner.node)
            state.links |= {link.name: link for link in runner.links.values()}

    async def _restart(self, runner: NodeRunner, anyway: bool) -> None:
        name = runner.spec.name
        # Shielded: the end of the run ends this task, but must not cut an on_shutdown short.
        await asyncio.shield(self._create_task(self._shut_down(runner), name))
        if runner.spec.on_error == "drop" and not anyway:
            log.warning("%s: left out from here on", name)
            return
        while not self._ended.is_set():
            pause = min(FIRST_BACKOFF * 2 ** min(runner.failures, 16), LONGEST_BACKOFF)
            runner.failures += 1
            log.warning("%s: restarts in %g s", name, pause)
            await self.state.clock.sleep(pause)
            try:
                await self._start_node(runner)
                limit = self.state.config.run.startup_limit
                runner.receive_announcements(self.state.announcements, limit)
                await runner.get_ready(limit)
            except NodeError as error:
                if isinstance(event_loop.leaf(error.__cause__ or error), FatalError):
                    log_error(error, last=True)
                    self.stop(f"{name} failed", error, by=name)
                    return
                log_error(error, last=False)
                await asyncio.shield(self._create_task(self._shut_down(runner), name))
                continue
            runner.restarting = False
            self.connect()
            self.services.run_node(runner)
            return

    # Ending.

    async def _end_all(self) -> None:
        for ticker in self.state.tickers.values():
            ticker.stopped = True
        for task in self._restarts:
            task.cancel()
        if self._restarts:
            await asyncio.wait(self._restarts)
        if not self.state.running:  # what has started may still send farewells to what has, too
            self.connect()
        for runner in self.state.runners.values():
            runner.first_error = self.state.error is None
            for error in await runner.end(self.state.shutdown_limit()):
                self.state.record_error(error)
        for name, runner in reversed(self.state.runners.items()):
            await self._wait_to_end(name)
            await self._shut_down(runner)
            self.others.node_ended(name)
        await self._wait_to_end("")

    async def _wait_to_end(self, name: str) -> None:
        try:
            await self.others.wait_to_end(name)
        except VisnavError as error:
            log.error("%s", error)
            self.state.record_error(error)

    async def _shut_down(self, runner: NodeRunner) -> None:
        """Shut a node down, once; from the first step on the node receives nothing."""
        async with runner.shutdown_lock:
            runner.stop_receiving()
            self.connect()
            runner.first_error = self.state.error is None
            for error in await runner.shut_down(self.state.shutdown_limit()):
                self.state.record_error(error)


def _give_up(_phase: Phase, _runner: NodeRunner, error: NodeError) -> None:
    raise error
