"""An instrument to note a run's steps and events: no more than a tuple each on the loop."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from events import Event
from runtime.channels.sender import Sender, Tap
from runtime.errors import ConfigError
from runtime.run.instruments import Call, Instrument
from runtime.run.supervisor import Supervisor
from runtime.time.clock import Clock, RealClock
from runtime.tools.tracing.spool import CHUNK, ClockRate, Spool
from runtime.tools.tracing.write import write_trace

log = logging.getLogger("visnav.runtime")


class TraceInstrument(Instrument):
    """An instrument to note steps, events, thread and worker calls in a `Spool`.

    Each note is a tuple that begins with its kind::

        "step", node, what, begin, end, run, cause
        "event", time, run, sender, type of event, source, stamp, identity, cause, listeners
        "thread", thread, node, function, submitted, begin, end
        "worker", process, method, asked, answered

    Times are nanoseconds of `time.perf_counter_ns`; `run` and `stamp` are of the run's clock, but
    for `run` in real time (see `ClockRate`). An identity is `id` of the event; a cause is the
    identity of the event that the innermost step was given, or 0.
    """

    def __init__(self, clock: Clock, spool: Spool) -> None:
        # In real time the two clocks are one but for origin and speed, so one look is enough.
        self._now = time.perf_counter_ns if isinstance(clock, RealClock) else clock.now
        self._clock = clock
        self._spool = spool
        self._notes: list[tuple[Any, ...]] = []
        self._cause = [0]
        self.beside: deque[tuple[Any, ...]] = spool.beside
        """Notes of other threads, barred from the loop's list."""
        self.event_sent: Tap = self._make_tap()

    def wrap_call(self, node: str, what: str, call: Call) -> Call:
        """Return a function to call `call` and note its begin and end."""
        notes, add, current, now = self._notes, self._notes.append, self._cause, self._now
        time_ns, flush, identity = time.perf_counter_ns, self._flush, id

        def noting(argument: Any) -> Any:
            before = current[0]
            # A tick, say, may lie where an event lay before.
            current[0] = cause = identity(argument) if isinstance(argument, Event) else 0
            run, begin = now(), time_ns()
            try:
                return call(argument)
            finally:
                add(("step", node, what, begin, time_ns(), run, cause))
                current[0] = before
                if len(notes) > CHUNK:
                    flush()

        return noting

    def _make_tap(self) -> Tap:
        notes, add, current, now = self._notes, self._notes.append, self._cause, self._now
        time_ns, flush, identity = time.perf_counter_ns, self._flush, id

        def tap(sender: Sender[Any] | None, event: Event) -> None:
            add(
                (
                    "event",
                    time_ns(),
                    now(),
                    sender,
                    type(event),
                    event.source,
                    event.stamp,
                    identity(event),
                    current[0],
                    None if sender is None else sender._candidates,
                )
            )
            if len(notes) > CHUNK:
                flush()

        return tap

    def wrap_offload(self, node: str, call: Callable[[], Any], name: str) -> Callable[[], Any]:
        """Return a function to call `call` and note its run in a thread."""
        submitted, note = time.perf_counter_ns(), self.beside.append

        def noting() -> Any:
            begin = time.perf_counter_ns()
            try:
                return call()
            finally:
                thread = threading.current_thread().name
                note(("thread", thread, node, name, submitted, begin, time.perf_counter_ns()))

        return noting

    def worker_called(
        self, process: str, method: str, answer: concurrent.futures.Future[Any]
    ) -> None:
        """Note a worker's call once answered."""
        asked = time.perf_counter_ns()
        answer.add_done_callback(
            lambda _: self.beside.append(("worker", process, method, asked, time.perf_counter_ns()))
        )

    def close(self) -> None:
        """Hand over the remaining notes, while the run's clock still goes."""
        if isinstance(self._clock, RealClock):
            real, run, speed = time.perf_counter_ns(), self._clock.now(), self._clock.speed
            self._spool.rate = ClockRate(round(real - run / speed), speed)
        self._flush()

    def _flush(self) -> None:
        self._spool.put(self._notes.copy())
        self._notes.clear()


@contextlib.contextmanager
def tracing(supervisor: Supervisor, path: Path, name: str) -> Iterator[None]:
    """Trace a run while the block lasts, then write (``.gz``: compressed); or `ConfigError`."""
    if not path.name or path.is_dir():
        raise ConfigError(f"{path}: expected the name of a file for a trace, found a folder")
    if path.exists() and not (path.is_file() or path.is_char_device()):
        raise ConfigError(f"{path}: expected the name of a file for a trace, found none")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.gettempdir() if path.is_char_device() else path.parent
        number, part = tempfile.mkstemp(".part", f"{path.name}.", folder)
        os.close(number)
        spool = Spool(Path(part))
    except OSError as error:
        raise ConfigError(
            f"{path}: expected a place for a trace, found: {error.strerror}"
        ) from None
    recorder = TraceInstrument(supervisor.state.clock, spool)
    supervisor.instruments.attach(recorder)
    try:
        yield
    finally:
        recorder.close()
        spool.close()
        if spool.failed is None:
            _write(spool, path, supervisor, name)
        spool.discard()


def _write(spool: Spool, path: Path, supervisor: Supervisor, name: str) -> None:
    order = [node.name for node in supervisor.state.all_nodes]
    try:
        write_trace(spool, path, name=name, clock=supervisor.state.clock.kind, nodes=order)
    except OSError as error:  # a full disk: the run's other results must not go with the trace
        log.error("%s: the trace could not be written: %s", path, error)
