"""Services of a run for its nodes, among them pausing and stepping simulated time.

Real time cannot be paused or stepped: sensors and vehicles do not wait. Time stands between two
instants: all that is due up to the instant at which it stands has been done, that instant
included, and all that is due later has not. What happens is therefore the same, in the same order,
in a run that is paused and stepped and in one that is not: they have equal digests.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import time
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from typing_extensions import TypeVar

from runtime.channels.hold import Hold, HoldConfig
from runtime.errors import CommandError
from runtime.time.clock import SECOND, Clock, Tick, Ticker
from runtime.time.lockstep import LockstepClock, LockstepLoop
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
        run_end: How the run ended; `None` before.
    """

    checking = False
    run_end: RunEnd | None = None

    def __init__(
        self,
        clock: Clock,
        seed: int = 0,
        siblings: tuple[Sibling, ...] = (),
        over: Callable[[], bool] = lambda: False,
    ) -> None:
        self.clock = clock
        self.seed = seed
        self.siblings = siblings
        self.out: Path | None = None
        self.out_of_programs: Path | None = None
        self.shared: dict[str, Any] = {}
        self.stepping = Stepping(clock, over)

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

    def hold(self, node: Any, name: str, config: HoldConfig, latency: float) -> Hold[Any]:  # noqa: ARG002
        """Make the hold of an outside system, and end the hold with the node."""
        return Hold(name, self.clock, config, latency)

    def offload(self, node: Any, call: functools.partial[Any]) -> concurrent.futures.Future[Any]:
        """Run a function of a node in a thread."""
        raise NotImplementedError

    def stop(self, node: Any, reason: str) -> None:
        """End the run in order, for a reason of a node's."""

    def conclude(
        self, subject: str, figures: Mapping[str, Any], passed: bool | None, flight: bool
    ) -> None:
        """Put a verdict into the summary."""

    def note_environment(self, name: str, value: str) -> None:
        """Record a dependency of the run in the summary."""

    def note_truth(self, subject: str, facts: Mapping[str, Any]) -> None:
        """Put what nobody may know during the run into its summary."""

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Call a function once the summary is written."""


class Stepping:
    """Control of a run's clock; the loop's `runtime.time.lockstep.Gate` while paused.

    All of its methods are called on the run's loop.

    Args:
        over: Tells whether the run is ending, which takes simulated time and cannot be paused.
        wall: Real seconds.
    """

    def __init__(
        self,
        clock: Clock,
        over: Callable[[], bool] = lambda: False,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        self._over = over
        self._wall = wall
        self._pauses: tuple[float | None, float] = None, 0.0
        """Start of the present pause (`wall`) or `None`, and seconds of earlier ones."""
        self._loop = clock._loop if isinstance(clock, LockstepClock) else None
        self._limit = 0
        self._steps: list[tuple[int, asyncio.Future[int]]] = []
        """Start (ns) and waiting future of each step in progress."""

    def fixed(self) -> str:
        """Return why time cannot be controlled; empty if controllable."""
        if self._loop is None:
            return "the run is in real time, which cannot be stopped: sensors do not wait"
        if self._loop.gate not in {None, self}:
            return "the run goes on in other processes, too, and time is common to all"
        return ""

    @property
    def state(self) -> Literal["running", "stepping", "paused"]:
        """Whether time runs, runs for a step, or stands."""
        if self._loop is None or self._loop.gate is not self or self._over():
            return "running"
        return "stepping" if self._steps else "paused"

    @property
    def target_speed(self) -> float | None:
        """Requested speed; `None` for as fast as possible, or for real time."""
        if self._loop is None or not self._loop._pace:
            return None
        return round(1.0 / (self._loop._pace * SECOND), 9)

    def may_go(self, key: tuple[int, int, int]) -> bool:
        """Tell whether the loop may go on to the next due entry."""
        if self._over():
            self._end_steps()
            return True
        if key[0] <= self._limit:
            return True
        assert self._loop is not None
        self._loop.now = max(self._loop.now, self._limit)  # nothing need be due there
        since, before = self._pauses
        self._pauses = self._wall() if since is None else since, before
        self._end_steps()
        return False

    def pause(self) -> None:
        """Pause time once all work due by now is done; ends a step. Raises as `resume` does."""
        loop = self._checked()
        self._limit = loop.now
        loop.gate = self

    def resume(self) -> None:
        """Let time run, and end a step; raise `CommandError` if time is not ours."""
        loop = self._checked()
        self._go_on()
        loop.gate = None
        loop._wall_origin = None  # else it would hurry to make up for the pause
        self._end_steps()

    def step(self, ns: int | None = None) -> asyncio.Future[int]:
        """Let time run for `ns` nanoseconds, or to what is due next, and then stand.

        A step that is asked for while another goes on is added to it. The result is the nanoseconds
        by which time has gone on: fewer if time was paused or resumed, or the run ended, before.

        Raises:
            CommandError: Time cannot be controlled.
            ValueError: `ns` is less than 1.
        """
        loop = self._checked()
        if ns is not None and ns < 1:
            raise ValueError(f"expected a step of 1 ns or more, found {ns}")
        self._go_on()
        begin = max(loop.now, self._limit) if loop.gate is self else loop.now
        self._limit = max(_next_due(loop), begin) if ns is None else begin + ns
        loop.gate = self
        loop._wall_origin = None
        done: asyncio.Future[int] = loop.create_future()
        self._steps.append((loop.now, done))
        return done

    def stands(self) -> asyncio.Future[int]:
        """Return a future done once time is paused; at once if no pause is requested.

        After `pause`, all else due now is still done before time stands. Raises as `resume` does.
        """
        loop = self._checked()
        done: asyncio.Future[int] = loop.create_future()
        self._steps.append((loop.now, done))
        if loop.gate is not self:
            self._end_steps()
        return done

    def pace(self, factor: float | None) -> None:
        """Set the speed in simulated seconds per real second (`None`: unlimited)."""
        loop = self._checked()
        loop._pace = 0.0 if factor is None else 1.0 / (factor * SECOND)
        loop._wall_origin = None

    def real_seconds(self) -> float:
        """Return real seconds without pauses; in any thread."""
        since, before = self._pauses
        return (self._wall() if since is None else since) - before

    def _go_on(self) -> None:
        since, before = self._pauses
        if since is not None:
            self._pauses = None, before + self._wall() - since

    def _end_steps(self) -> None:
        assert self._loop is not None
        steps, self._steps = self._steps, []
        for begin, done in steps:
            if not done.done():  # whoever waited may have been cancelled
                done.set_result(self._loop.now - begin)

    def _checked(self) -> LockstepLoop:
        if reason := self.fixed():
            raise CommandError(reason)
        assert self._loop is not None
        return self._loop


def _next_due(loop: LockstepLoop) -> int:
    """Return when the next entry, timer or work in a thread is due (ns); 0 if there is none."""
    entry = loop.schedule.next_due()
    due = [] if entry is None else [entry]
    due += [round(timer.when() * SECOND) for timer in loop._scheduled[:1]]  # type: ignore[attr-defined]
    due += [held[0] for held in loop._held[:1]]
    return min(due, default=0)
