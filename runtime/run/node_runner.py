"""A running node: its tasks, limits and errors, and the phases up to the first update.

A node may raise whatever it likes, `SystemExit` and the like included, and swallow its
cancellation: each of its steps is a task, waited for within a limit and then left behind. The
phases, the same in a run and in a check of its file (`start_up`):

    construct → on_startup, in file order
    announce → on_announcement, check
    on_ready, in file order
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable
from typing import TYPE_CHECKING, Any, Literal

from events import Announcement
from runtime.channels.links import Link
from runtime.channels.sources import SourceOwners
from runtime.config.model import NodeSpec
from runtime.errors import (
    ChannelSourceError,
    NodeError,
    NodeTimeoutError,
    RefusedError,
    VisnavError,
)
from runtime.host import Host
from runtime.json_values import plain
from runtime.node import Node, make_node, streams
from runtime.run import event_loop
from runtime.time.clock import Ticker
from runtime.time.real_time import ended

if TYPE_CHECKING:
    from runtime.channels.hold import Hold
    from runtime.workers.worker import Worker

log = logging.getLogger("visnav.runtime")

MOST_VALUES = 10_000  # announcements of a node, or unmet needs

GRACE = 0.5  # real seconds for a step to end after its cancellation, such as over its limit

Create = Callable[[Coroutine[Any, Any, Any], str], asyncio.Task[Any]]


class NodeRunner:
    """State of a node in a run: its tasks, tickers, workers, holds, links and phase."""

    def __init__(self, spec: NodeSpec, create: Create) -> None:
        self.spec = spec
        self.node: Node[Any] | None = None
        self.tasks: dict[asyncio.Task[None], None] = {}  # in the order in which they were made
        self.tickers: list[Ticker] = []
        self.workers: list[Worker[Any]] = []
        self.holds: list[Hold[Any]] = []
        self.links: dict[str, Link] = {}
        self.started = False
        self.starts = 0
        self.failures = 0
        self.running_since = 0  # start of the node's ticks and `run`, on the run's clock (ns)
        self.restarting = False
        self.shutting_down = False
        self.shutdown_lock = asyncio.Lock()
        self.phase = ""
        self.phase_task: asyncio.Task[Any] | None = None
        self._create = create
        self._succeeded = False
        self.first_error = False
        """Whether an error in a step of the end is the run's error, to be printed then."""

    @property
    def doing(self) -> str:
        """Work of the node in its own words, its phase, or ""; for any thread."""
        return (self.node.doing if self.node is not None else "") or self.phase

    def awaited(self) -> list[asyncio.Task[Any]]:
        """Return the tasks awaited by the run in this phase."""
        return [self.phase_task] if self.phase_task is not None else list(self.tasks)

    async def start_up(self, host: Host, limit: float) -> None:
        """Make the node and the links before its ports, and run `on_startup`.

        Raises:
            NodeError: The node failed, or took longer than `limit` (real s).
        """
        spec = self.spec
        self.shutting_down = False
        try:
            self.node = make_node(spec.node, spec.name, spec.config, host, spec.inputs, self.starts)
            self.links = {
                port: Link(
                    f"{spec.name}.{port}", config, host.clock, host.seed, self.links.get(port)
                )
                for port, config in spec.links.items()
            }
            startup = self.node.on_startup()
        except BaseException as error:
            raise wrap(spec.name, error) from error
        try:
            await self._within(limit, "on_startup", startup)
        finally:  # it may have ended well though the run did not want it any more
            self.started = self._succeeded
            self.starts += self._succeeded

    def announcements(self, limit: float) -> list[Announcement]:
        """Return the node's announcements, within a limit (real s), or raise `NodeError`."""
        assert self.node is not None
        name = self.spec.name
        try:
            values: Any = self.node.announce()
            values = values if isinstance(values, Iterable) else [values]
            announced = self._items("announce", values, limit)
            for announcement in announced:
                if not isinstance(announcement, Announcement):
                    raise NodeError(
                        name,
                        "announce(): expected announcements, "
                        f"found {announcement!r:.80} ({type(announcement).__name__})",
                    )
                plain(announcement, f"announce(): {type(announcement).__name__}")
            return announced
        except BaseException as error:
            raise wrap(name, error) from error

    def _items(self, phase: str, items: Iterable[Any], limit: float) -> list[Any]:
        """Return the values of a phase, which may be endless; or raise `NodeError`."""
        values: list[Any] = []
        until = time.monotonic() + limit
        for value in items:
            if len(values) == MOST_VALUES:
                raise NodeError(
                    self.spec.name,
                    f"{phase}(): expected an end after at most {MOST_VALUES:,} values, found more",
                )
            if time.monotonic() > until:
                raise self._too_late(phase, limit, "")
            values.append(value)
        return values

    def receive_announcements(self, announcements: Iterable[Announcement], limit: float) -> None:
        """Hand the node all announcements, then call its `check`, within a limit (real s).

        Raises:
            NodeError: The node failed; a `RefusedError` if it cannot work with one, or lacks
                something.
        """
        assert self.node is not None
        name = self.spec.name
        for announcement in announcements:
            try:
                self.node.on_announcement(announcement)
            except ValueError as error:
                what = f"cannot work with {announcement.source}: {error}"
                raise RefusedError(name, what) from error
            except BaseException as error:
                raise wrap(name, error) from error
        try:
            lacks = self._items("check", self.node.check(), limit)
        except BaseException as error:
            raise wrap(name, error) from error
        if lacks:
            raise RefusedError(name, "; ".join(lacks))

    async def get_ready(self, limit: float) -> None:
        """Run the node's `on_ready` within a limit (real s), or raise `NodeError`."""
        assert self.node is not None
        await self._within(limit, "on_ready", self.node.on_ready())

    async def end(self, limit: float) -> list[NodeError]:
        """Run the node's `on_end` within a limit (real seconds), and return its errors."""
        node = self.node
        if node is None or not self.started or type(node).on_end is Node.on_end:
            return []
        async with self.shutdown_lock:
            return await self._last_step(limit, "on_end", node.on_end())

    def stop_receiving(self) -> None:
        """Stop delivering events to the node."""
        self.shutting_down = True
        for link in self.links.values():
            link.close()

    async def shut_down(self, limit: float) -> list[NodeError]:
        """End ticks, tasks, node and workers, within a limit (real s) each; return the errors.

        For a node that receives nothing any more (`stop_receiving`).
        """
        node, wrong = self.node, []
        for ticker in self.tickers:
            ticker.stopped = True
        self.tickers.clear()
        for hold in self.holds:  # before the systems are told to end: what they leave is not lost
            hold.close()
        self.holds.clear()
        wrong += await self._end_tasks(limit)
        if node is not None and self.started:
            wrong += await self._last_step(limit, "on_shutdown", node.on_shutdown())
            wrong += await self._end_tasks(limit)  # those that it started meanwhile
        workers = [asyncio.create_task(asyncio.to_thread(worker.close)) for worker in self.workers]
        wrong += await self._end_by(limit, "its workers", workers)
        self.workers.clear()
        self.started = False
        if node is not None:
            for stream in streams(node).values():
                stream.close()
        return wrong

    async def _last_step(
        self, limit: float, what: str, coro: Coroutine[Any, Any, Any]
    ) -> list[NodeError]:
        """Run a step of the end; log and return its errors instead of raising them."""
        try:
            await self._within(limit, what, coro)
        except BaseException as error:
            if isinstance(error, asyncio.CancelledError) and _is_cancelled():
                raise
            wrong = wrap(self.spec.name, error)
            log_error(wrong, last=self.first_error)
            self.first_error = False
            return [wrong]
        return []

    async def _within(self, limit: float, what: str, coro: Coroutine[Any, Any, Any]) -> None:
        """Run a step of the node as a task left behind after the limit; raise `NodeError`."""
        task = self._create(_outcome(coro), self.spec.name)
        if inspect.iscoroutine(coro):  # which it may never begin, if it is cancelled at once
            task.add_done_callback(lambda _: coro.close())
        self.phase, self.phase_task = what, task
        try:
            late = await ended([task], limit)
            place = event_loop.of_task(task)[1] if late else ""
        finally:
            if not task.done():
                task.cancel()
                await ended([task], GRACE)
            self.phase, self.phase_task = "", None
            self._succeeded = task.done() and not task.cancelled() and task.result() is None
        if late:
            raise self._too_late(what, limit, place)
        error = None if task.cancelled() else task.result()
        if error is not None:
            raise wrap(self.spec.name, error) from error

    async def _end_tasks(self, limit: float) -> list[NodeError]:
        wrong: list[NodeError] = []
        until = time.monotonic() + limit
        while self.tasks:
            tasks = list(self.tasks)
            for task in tasks:
                task.cancel()
            wrong += await self._end_by(until - time.monotonic(), "its tasks", tasks, limit)
            for task in tasks:
                self.tasks.pop(task, None)
        return wrong

    async def _end_by(
        self, seconds: float, what: str, tasks: list[asyncio.Task[Any]], limit: float = 0.0
    ) -> list[NodeError]:
        self.phase = what if tasks else ""
        late = await ended(tasks, max(seconds, 0.0))
        self.phase = ""
        wrong: list[NodeError] = [
            self._too_late(what, limit or seconds, event_loop.of_task(task)[1]) for task in late[:1]
        ]
        for error in wrong:
            log_error(error, last=False)
        return wrong

    def _too_late(self, what: str, limit: float, place: str) -> NodeTimeoutError:
        starting = {"on_startup", "announce", "check", "on_ready"}
        setting = "startup_limit" if what in starting else "shutdown_limit"
        late = NodeTimeoutError(
            self.spec.name,
            f"expected {what} to end within {limit:.3g} s (run.{setting}), found it still running",
        )
        late.place = place
        return late


def log_error(error: NodeError, *, last: bool) -> None:
    """Log a node's error, with the traceback of a foreign one; `last`: it is printed, too."""
    cause = error.__cause__
    ours = isinstance(event_loop.leaf(error if cause is None else cause), VisnavError)
    log.error("%s", with_place(error), exc_info=None if ours else cause, extra={"reported": last})


def with_place(error: Exception) -> str:
    """Return an error's message, with the raising line if known."""
    place = getattr(error, "place", "")
    return f"{error} ({event_loop.short(place)})" if place else str(error)


def wrap(name: str, error: BaseException) -> NodeError:
    """Return a node's exception as a `NodeError` naming the node; a `NodeError` as is."""
    if isinstance(error, NodeError):
        return error
    leaf = event_loop.leaf(error)
    if isinstance(leaf, VisnavError):  # says all there is to say; others need their type
        wrapped = NodeError(name, str(leaf).removeprefix(f"{name}: "))
    else:
        wrapped = NodeError(name, _described(leaf))
        place = getattr(leaf, "place_in_worker", "")
        wrapped.place = place or (event_loop.of_error(leaf)[1] if leaf.__traceback__ else "")
    wrapped.__cause__ = error
    return wrapped


def _described(error: BaseException) -> str:
    """Return an exception's type and message as a line; of a group, those of its parts."""
    if isinstance(error, BaseExceptionGroup):
        parts = [_described(event_loop.leaf(part)) for part in error.exceptions]
        return f"{len(parts)} errors: " + "; ".join(parts)
    try:
        text = " ".join(str(error).split())
    except Exception:  # its own fault, too
        text = "a message that cannot be made"
    if isinstance(error, SystemExit | KeyboardInterrupt):
        text = f"{text} (expected self.stop(reason), which ends a run)".strip()
    return f"{type(error).__name__}: {text}"


async def _outcome(coro: Coroutine[Any, Any, Any]) -> BaseException | None:
    """Await a step of a node, and return its exception: some would end the loop."""
    try:
        await coro
    except BaseException as error:
        return error
    return None


def _is_cancelled() -> bool:
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


Phase = Literal["on_startup", "announce", "check", "on_ready"]

Announced = dict[str, list[Announcement]]  # announcements of each node, by name

Step = Callable[[NodeRunner], Awaitable[None]]


async def start_up(
    runners: Collection[NodeRunner],
    *,
    start: Step,
    exchange: Callable[[Announced], Awaitable[list[Announcement]]],
    ready: Step | None = None,
    failed: Callable[[Phase, NodeRunner, NodeError], None],
    owners: SourceOwners,
    limit: float,
    give_up: Callable[[], bool] = lambda: False,
) -> None:
    """Run the phases of all nodes up to the first update.

    Args:
        start: Constructs a node and runs its `on_startup`.
        exchange: Given what the nodes here announce, returns what all nodes of the run announce.
        ready: Runs a node's `on_ready`; without it, that phase is left out.
        failed: Called when a node fails; if it returns, the next node follows.
        limit: For what a node announces and checks, real seconds.
        give_up: Asked, once all nodes had their `on_startup`, whether to leave out what follows.
    """
    announced: Announced = {}
    for runner in runners:
        try:
            await start(runner)
        except NodeError as error:
            failed("on_startup", runner, error)
    if give_up():
        return
    for runner in runners:
        try:
            announced[runner.spec.name] = announcements = runner.announcements(limit)
            for announcement in announcements:
                try:
                    owners.announce(runner.spec.name, announcement)
                except ChannelSourceError as error:
                    raise wrap(runner.spec.name, error) from error
        except NodeError as error:
            failed("announce", runner, error)
    everything = await exchange(announced)
    for runner in runners:
        try:
            runner.receive_announcements(everything, limit)
        except NodeError as error:
            failed("check", runner, error)
    if ready is None:
        return
    for runner in runners:
        try:
            await ready(runner)
        except NodeError as error:
            failed("on_ready", runner, error)
