"""Reports what a run waits for when nothing goes on: which node, which line, which wait.

A thread looks at the run a few times per limit. When it finds that neither the run's time nor its
phase has changed for half of it, it asks the loop to explain. A loop that runs without time
passing says whose tasks are ready, again and again; one that does not answer is blocked, and the
thread says where. A node that blocks the loop beyond the limit of its start or end is interrupted,
for no task of the run could do that. Short stalls: `runtime.watchdogs.loop`.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import threading
import time
from collections import Counter
from types import TracebackType
from typing import Any

from runtime import code_location
from runtime.errors import NodeTimeoutError
from runtime.frames import frame_of
from runtime.lockstep import LockstepLoop
from runtime.run_state import RunState
from runtime.stepping import Stepping
from runtime.time_limits import Starvation
from runtime.watchdogs.loop import idle

log = logging.getLogger("visnav.runtime")

_LONGEST_PAUSE = 0.25
_LOOK = 0.01
"""Real seconds between two looks at what a busy loop does."""

_MOST_NAMED = 3

_PATIENCE = 3.0
"""Real seconds after Ctrl-C in which a node that blocks the loop in the start-up may go on."""


class ProgressWatchdog:
    """Watches a run of the thread that makes it; a context as long as the run.

    Args:
        state: Of the run.
        loop: Its loop.
        limit: Real seconds without progress after which this is reported; 0 for never.
    """

    def __init__(self, state: RunState, loop: asyncio.AbstractEventLoop, limit: float) -> None:
        self._state = state
        self._loop = loop
        self._limit = limit
        self._thread_id = threading.get_ident()
        self._main = threading.current_thread() is threading.main_thread()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="progress", daemon=True)

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
        while not self._end.wait(min(self._limit / 8, _LONGEST_PAUSE)):
            found, now = self._mark(), time.monotonic()
            if self._is_deaf():
                deaf = deaf or now
                if self._main and now - deaf > _PATIENCE:
                    deaf = now
                    self._interrupt()
            if found != mark:
                mark, since, due, interrupted = found, now, self._limit, now
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
        """Tell whether Ctrl-C is not heard before the first update, as somebody blocks the loop."""
        run = self._state
        return bool(run.stop_requested) and run.stopped is None and run.first_update is None

    def _mark(self) -> tuple[Any, ...]:
        """Return what is the same for as long as nothing goes on; in any thread."""
        run = self._state
        now = self._loop.now if isinstance(self._loop, LockstepLoop) else 0
        phases = tuple((runner.starts, runner.phase) for runner in list(run.runners.values()))
        return now, run.first_update, run.stopped, run.stop_requested, phases

    def _ask(self, until: float, seen: Counter[tuple[str, str]]) -> str | None:
        """Let the loop explain, and note where it is meanwhile; `None` if it does not answer."""
        answers: list[tuple[str, list[tuple[str, str]]]] = []
        asked = known = 0

        def explain() -> None:
            answer = self._explain()
            answers.append((answer, code_location.ready_on(self._loop) if answer == "busy" else []))

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
                seen[code_location.of_thread(frame)] += 1
            del frame
            if time.monotonic() >= until:
                break
            self._end.wait(_LOOK)
        if not seen and (not known or answers[-1][0] == "busy"):  # idle, and only slow to wake up
            return ""
        return answers[-1][0] if known else None

    def _explain(self) -> str:
        """Return who is waited for; ``""`` if all is well, ``"busy"`` if nobody is; on the loop."""
        run, loop = self._state, self._loop
        waiting = [runner for runner in run.runners.values() if runner.phase]
        if waiting:
            return "; ".join(
                f"{runner.spec.name}: {runner.phase}{_at(runner.awaited())}"
                for runner in waiting[:_MOST_NAMED]
            )
        if run.first_update is None or run.stopped is not None:
            return "the other processes of the run" if run.several_processes else ""
        return _explain_time(loop, run) if isinstance(loop, LockstepLoop) else ""

    def _message(self, answer: str | None, seen: Counter[tuple[str, str]], seconds: float) -> str:
        places_seen = [place for place, _ in seen.most_common()] or [("runtime", "?")]
        node, line = places_seen[0]
        if answer is None:
            where = code_location.short(line)
            return f"the loop has not turned for {seconds:.1f} s: {node}, at {where}"
        if answer == "busy":
            of_nodes = [place for place in places_seen if place[0] != "runtime"] or places_seen[:1]
            names = ", ".join(list(dict(of_nodes))[:_MOST_NAMED])
            return (
                f"no time has passed for {seconds:.1f} s, while these run again and again: "
                f"{names}, at {code_location.short(of_nodes[0][1])}"
            )
        return f"for {seconds:.1f} s the run has waited for {answer}"

    def _blocking_limit(self) -> float:
        """Return how long a node may block the loop: as long as the step may take that it is in."""
        run = self._state
        if run.stopped is not None or run.stop_requested:
            return run.shutdown_limit()
        return run.config.run.startup_limit if run.first_update is None else float("inf")

    def _interrupt(self) -> None:
        """Raise an error in whatever blocks the loop, by a signal."""
        node, line = code_location.of_thread(frame_of(self._thread_id))
        if node == "runtime":  # it is not a node that blocks, or does no more
            return
        setting = "startup_limit" if self._state.first_update is None else "shutdown_limit"
        error = NodeTimeoutError(
            node, f"expected it to give back the loop (run.{setting}), found it blocking it"
        )
        error.place = line
        self._state.interruption = error
        signal.pthread_kill(self._thread_id, signal.SIGUSR2)


def _explain_time(loop: LockstepLoop, run: RunState) -> str:
    """Describe what simulated time waits for."""
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
        if code_location.waits_for(task, wait):
            node, line = code_location.of_task(task)
            return f"{node}: slow work, at {code_location.short(line)}"
    return "slow work beside the loop"


def _all(run: RunState) -> str:
    """Return where all nodes wait, as far as there is room."""
    found = [(runner.spec.name, task) for runner in run.runners.values() for task in runner.tasks]
    listed = ", ".join(f"{name}{_at([task])}" for name, task in found[:_MOST_NAMED])
    more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    return f" ({listed}{more})" if listed else ""


def _at(tasks: Any) -> str:
    """Return at which line the first of some tasks waits that has not ended."""
    waiting = [task for task in tasks if not task.done()]
    return f", at {code_location.short(code_location.of_task(waiting[0])[1])}" if waiting else ""
