"""Watchdogs: threads to detect a loop without turns, and a run without progress.

A watchdog looks a few times per limit. `LoopWatchdog`, where it finds the loop busy, asks it to
sign a note; a note that stays unsigned for the limit is a stall, reported with the node and the
line. An idle loop is never woken, and events cost nothing.

`ProgressWatchdog`, when neither the run's time nor its phase has changed for half of its limit,
asks the loop to explain: which node waits, where, for what; or, of a loop that runs without time
passing, whose tasks are ready again and again. A loop that does not answer is blocked, and the
thread says where. A node that blocks it beyond the limit of its start or end is interrupted, for
no task of the run could do that.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import selectors
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from runtime.errors import NodeTimeoutError
from runtime.logs import RunThread
from runtime.run import event_loop
from runtime.run.event_loop import frame_of
from runtime.run.node_runner import NodeRunner
from runtime.run.run_state import RunState
from runtime.summary import Stall
from runtime.time import lockstep
from runtime.time.lockstep import LockstepLoop
from runtime.time.real_time import Starvation
from runtime.time.stepping import Stepping

_LONGEST_PAUSE = 0.05  # seconds between two looks at most; a run's end waits for the last of them

_WAITING = {selectors.__file__, lockstep.__file__}
"""Modules with the wait of an idle loop, if called from `_LOOPS`."""

_LOOPS = {asyncio.base_events.__file__, asyncio.runners.__file__}
"""Callers of an idle loop's wait; compiled uvloop shows nothing but `Runner.run`.

A node that waits for a lock or a child's output is not idle: it blocks the loop.
"""


class LoopWatchdog:
    """Watchdog for the loop of the constructing thread.

    Args:
        limit: Real seconds without a turn that are a stall; 0 watches nothing.
        report: Called with each stall once it is over; from the watchdog's thread.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, limit: float, report: Callable[[Stall], None]
    ) -> None:
        self._loop = loop
        self._limit = limit
        self._report = report
        self._thread_id = threading.get_ident()
        self._signed = threading.Event()
        self._end = threading.Event()
        self._thread = RunThread(target=self._watch, name="watchdog", daemon=True)
        self.stalls: Counter[str] = Counter()
        self.longest: dict[str, Stall] = {}

    def start(self) -> None:
        """Begin to watch."""
        if self._limit > 0:
            self._thread.start()

    def stop(self) -> None:
        """Watch no more."""
        self._end.set()
        self._signed.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        pause = min(self._limit / 4, _LONGEST_PAUSE)
        while not self._end.is_set():
            time.sleep(pause)  # an `Event.wait` with a time-out costs five times as much
            frame = frame_of(self._thread_id)
            if frame is None or idle(frame):
                continue
            del frame
            self._signed.clear()
            if self._end.is_set():  # `stop` may have signed just before the note was wiped
                return
            asked = time.monotonic()
            try:
                self._loop.call_soon_threadsafe(self._signed.set)
            except RuntimeError:  # closed
                return
            if self._signed.wait(self._limit) or self._end.is_set():
                continue
            node, line = event_loop.of_thread(frame_of(self._thread_id))
            self._signed.wait()
            if not self._end.is_set():
                self._count(Stall(node, line, time.monotonic() - asked))

    def _count(self, stall: Stall) -> None:
        self.stalls[stall.node] += 1
        longest = self.longest.get(stall.node)
        if longest is None or stall.seconds > longest.seconds:
            self.longest[stall.node] = stall
        with contextlib.suppress(Exception):  # a report that fails must not end the watch
            self._report(stall)


def idle(frame: FrameType | None) -> bool:
    """Return whether a loop whose thread has this frame has nothing to do."""
    while frame is not None and frame.f_code.co_filename in _WAITING:
        frame = frame.f_back
    return frame is None or frame.f_code.co_filename in _LOOPS


log = logging.getLogger("visnav.runtime")

_LONGEST_LOOK = 0.25
_LOOK = 0.01  # real seconds between two looks at a busy loop

_MOST_NAMED = 3

_PATIENCE = 3.0  # real seconds after Ctrl-C until a start-up blocking the loop is interrupted


class ProgressWatchdog:
    """Watchdog for a run of the constructing thread; a context manager around the run.

    Args:
        limit: Real seconds without progress until a report; 0 for never.
    """

    def __init__(self, state: RunState, loop: asyncio.AbstractEventLoop, limit: float) -> None:
        self._state = state
        self._loop = loop
        self._limit = limit
        self._thread_id = threading.get_ident()
        self._main = threading.current_thread() is threading.main_thread()
        self._end = threading.Event()
        self._thread = RunThread(target=self._watch, name="progress", daemon=True)

    def __enter__(self) -> None:
        if self._limit > 0:
            self._thread.start()

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        mark: Any = None
        starvation = Starvation()
        since, due, interrupted, deaf = 0.0, 0.0, 0.0, 0.0
        while not self._end.wait(min(self._limit / 8, _LONGEST_LOOK)):
            current, now = self._mark(), time.monotonic()
            if self._is_deaf():
                deaf = deaf or now
                if self._main and now - deaf > _PATIENCE:
                    deaf = now
                    self._interrupt()
            if current != mark:
                mark, since, due, interrupted = current, now, self._limit, now
                starvation = Starvation()
                if self._state.first_update is None:
                    starvation.look()  # from here on
            waited = now - since
            if self._state.first_update is None and waited >= due / 2:
                waited -= starvation.look()  # a start that computes is not waited for
            if waited < due / 2:
                continue
            seen: Counter[tuple[str, str]] = Counter()
            answer = self._ask(max(min(since + due, now + 1.0), now + self._limit / 4), seen)
            if self._end.is_set():
                return
            if answer == "" or self._mark() != mark:
                since = now
                continue
            if time.monotonic() >= since + due:
                log.warning("%s", self._message(answer, seen, time.monotonic() - since))
                due *= 2
            if (
                self._main
                and answer is None
                and time.monotonic() - interrupted - starvation.look() > self._blocking_limit()
            ):
                interrupted, starvation = time.monotonic(), Starvation()
                self._interrupt()

    def _is_deaf(self) -> bool:
        """Return whether a node blocks the loop during start-up after Ctrl-C."""
        run = self._state
        return bool(run.stop_requested) and run.stopped is None and run.first_update is None

    def _mark(self) -> tuple[Any, ...]:
        run = self._state
        now = self._loop.now if isinstance(self._loop, LockstepLoop) else 0
        phases = tuple((runner.starts, runner.phase) for runner in list(run.runners.values()))
        return now, run.first_update, run.stopped, run.stop_requested, phases

    def _ask(self, until: float, seen: Counter[tuple[str, str]]) -> str | None:
        answers: list[tuple[str, list[tuple[str, str]]]] = []
        asked = known = 0

        def explain() -> None:
            answer = self._explain()
            answers.append((answer, event_loop.ready_on(self._loop) if answer == "busy" else []))

        while not self._end.is_set():
            for _, running in answers[known:]:
                known += 1
                seen.update(running)
            if known and answers[-1][0] != "busy":
                break
            if known == asked:
                asked += 1
                try:  # a turn later: by then what has woken the loop to ask it is done
                    self._loop.call_soon_threadsafe(self._loop.call_soon, explain)
                except RuntimeError:  # closed
                    return ""
            frame = frame_of(self._thread_id)
            if not known and frame is not None and not idle(frame):
                seen[event_loop.of_thread(frame)] += 1
            del frame
            if time.monotonic() >= until:
                break
            self._end.wait(_LOOK)
        if not seen and (not known or answers[-1][0] == "busy"):  # idle, and only slow to wake up
            return ""
        return answers[-1][0] if known else None

    def _explain(self) -> str:
        """Return the awaited nodes; ``""``: all is well, ``"busy"``: none; on the loop."""
        run, loop = self._state, self._loop
        waiting = [runner for runner in run.runners.values() if runner.phase]
        if waiting:
            return "; ".join(
                f"{runner.spec.name}: {_doing(runner)}" for runner in waiting[:_MOST_NAMED]
            )
        if run.first_update is None or run.stopped is not None:
            return "the other processes of the run" if run.several_processes else ""
        return _explain_time(loop, run) if isinstance(loop, LockstepLoop) else ""

    def _message(self, answer: str | None, seen: Counter[tuple[str, str]], seconds: float) -> str:
        places_seen = [place for place, _ in seen.most_common()] or [("runtime", "?")]
        node, line = places_seen[0]
        if answer is None:
            where = event_loop.short(line)
            return f"the loop has not turned for {seconds:.1f} s: {node}, at {where}"
        if answer == "busy":
            of_nodes = [place for place in places_seen if place[0] != "runtime"] or places_seen[:1]
            names = ", ".join(list(dict(of_nodes))[:_MOST_NAMED])
            return (
                f"no time has passed for {seconds:.1f} s, while these run again and again: "
                f"{names}, at {event_loop.short(of_nodes[0][1])}"
            )
        return f"for {seconds:.1f} s the run has waited for {answer}"

    def _blocking_limit(self) -> float:
        """Return the limit (real s) for a node to block the loop in its present step."""
        run = self._state
        if run.stopped is not None or run.stop_requested:
            return run.shutdown_limit()
        return run.config.run.startup_limit if run.first_update is None else float("inf")

    def _interrupt(self) -> None:
        node, line = event_loop.of_thread(frame_of(self._thread_id))
        if node == "runtime":  # it is not a node that blocks, or does no more
            return
        setting = "startup_limit" if self._state.first_update is None else "shutdown_limit"
        error = NodeTimeoutError(
            node, f"expected it to give back the loop (run.{setting}), found it blocking it"
        )
        error.place = line
        self._state.interruption = error
        signal.pthread_kill(self._thread_id, signal.SIGUSR2)


def _doing(runner: NodeRunner) -> str:
    """Return a node's status text, or its phase and line."""
    if runner.doing != runner.phase:
        return runner.doing
    return f"{runner.phase}{_at(runner.awaited())}"


def _explain_time(loop: LockstepLoop, run: RunState) -> str:
    if isinstance(loop.gate, Stepping):
        if loop.gate.state == "paused":
            return ""
    elif loop.gate is not None:
        return "the other processes of the run"
    if (wait := loop.waits_for()) is None:
        return "busy"
    if not isinstance(wait, asyncio.Future):
        return "" if wait == "pace" else f"nothing: nothing is due any more{_all(run)}"
    for task in asyncio.all_tasks(loop):
        if event_loop.waits_for(task, wait):
            node, line = event_loop.of_task(task)
            return f"{node}: slow work, at {event_loop.short(line)}"
    return "slow work beside the loop"


def _all(run: RunState) -> str:
    tasks = [(runner.spec.name, task) for runner in run.runners.values() for task in runner.tasks]
    listed = ", ".join(f"{name}{_at([task])}" for name, task in tasks[:_MOST_NAMED])
    more = f" and {len(tasks) - _MOST_NAMED} more" if len(tasks) > _MOST_NAMED else ""
    return f" ({listed}{more})" if listed else ""


def _at(tasks: Any) -> str:
    waiting = [task for task in tasks if not task.done()]
    return f", at {event_loop.short(event_loop.of_task(waiting[0])[1])}" if waiting else ""
