"""An instrument to note a run's steps and events: no more than a tuple each on the loop.

The notes go into a file during the run, to bound the memory. A thread encodes a list of notes at a
time, which is short enough not to be felt on the loop.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import queue
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from events import Category, Event, Image, Setpoint
from runtime.channels.sender import Sender, Tap
from runtime.errors import ConfigError
from runtime.run.instruments import Call, Instrument
from runtime.run.supervisor import Supervisor
from runtime.time.clock import Clock, RealClock

log = logging.getLogger("visnav.runtime")

CHUNK = 1024  # notes per list, about; encoding a list takes some tenths of a millisecond

_LENGTH_BYTES = 4


class EventKind(msgspec.Struct, frozen=True):
    """Properties of a type of event for traces.

    Attributes:
        measured: Whether it is a sensor's: a path may begin with it.
        image: Whether it is a camera's, which is preferred to other sensors'.
        setpoint: Whether it is a set-point: a path ends with it.
    """

    measured: bool
    image: bool
    setpoint: bool


class EventNote(NamedTuple):
    """The note of an event, as read from the spool.

    Attributes:
        time: Of sending, real time (ns).
        run: Of sending, the run's clock (ns).
        sender: ``node.port``.
        identity: Its `id`.
        given: The `id` of the event that the step which sent it was handling; 0 if none.
    """

    time: int
    run: int
    sender: str
    event: str
    source: str
    stamp: int
    identity: int
    given: int


class ClockRate(NamedTuple):
    """How the run's clock follows real time; `run` of a note is then real time, too.

    Attributes:
        origin: When the run's clock showed 0.
        speed: Its seconds per real second.
    """

    origin: int
    speed: float

    def run(self, real: int) -> int:
        """Return the time of the run's clock (ns) at a real time; 0 before its begin."""
        return max(round((real - self.origin) * self.speed), 0)


class Spool:
    """A file of notes.

    Args:
        path: Of the file; it is deleted when the notes have been read.

    Attributes:
        beside: Notes of other threads than the loop's.
        kinds: What is known of each type of event, by name.
        receivers: Nodes that hear events of a sender, type and source.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.beside: deque[tuple[Any, ...]] = deque()
        self.rate: ClockRate | None = None
        self.kinds: dict[str, EventKind] = {}
        self.receivers: dict[tuple[str, str, str], tuple[str, ...]] = {}
        self.origin = time.perf_counter_ns()
        """Begin of the notes: `time.perf_counter_ns` before all of them."""
        self.failed: OSError | None = None  # why there can be no trace any more
        self._file = path.open("wb", buffering=0)
        self._lists: queue.SimpleQueue[list[tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._encode = msgspec.msgpack.Encoder().encode
        self._thread = threading.Thread(target=self._write, name="trace", daemon=True)
        self._thread.start()

    def put(self, notes: list[tuple[Any, ...]]) -> None:
        """Take a list of notes, in the order of their making."""
        self._lists.put(notes)

    def close(self) -> None:
        """Write the remaining notes; nothing is taken afterwards."""
        self._lists.put(None)
        self._thread.join()
        self._file.close()

    def discard(self) -> None:
        """Delete the file."""
        self.path.unlink(missing_ok=True)

    def read(self) -> Iterator[list[Any]]:
        """Yield all notes in the order of taking, and delete the file."""
        with self.path.open("rb") as file:
            while length := file.read(_LENGTH_BYTES):
                yield from msgspec.msgpack.decode(file.read(int.from_bytes(length, "little")))
        self.discard()

    def _write(self) -> None:
        while (notes := self._lists.get()) is not None:
            self._try_to_append(self._drained() + notes)
        self._try_to_append(self._drained())

    def _try_to_append(self, notes: list[tuple[Any, ...]]) -> None:
        if self.failed is None:
            try:
                self._append(notes)
            except OSError as error:  # a full disk, which must not spoil the run
                self.failed = error
                log.warning("no trace from here on: %s", error)

    def _drained(self) -> list[tuple[Any, ...]]:
        found = []
        while self.beside:
            found.append(self.beside.popleft())
        return found

    def _append(self, notes: list[tuple[Any, ...]]) -> None:
        content = self._encode([self._plain(n) if n[0] == "event" else n for n in notes])
        rest = memoryview(len(content).to_bytes(_LENGTH_BYTES, "little") + content)
        while rest:
            rest = rest[self._file.write(rest) :]

    def _plain(self, note: tuple[Any, ...]) -> tuple[Any, ...]:
        _, time, run, sender, event, source, stamp, identity, cause, listeners = note
        name = "run.announced" if sender is None else sender.name
        key = (name, event.__name__, source)
        if key not in self.receivers:
            heard = (each.node for each in listeners or () if each.receives(event, source))
            self.receivers[key] = tuple(dict.fromkeys(heard))
            self.kinds[event.__name__] = _kind(event)
        return ("event", *EventNote(time, run, *key, stamp, identity, cause))


def _kind(event: type[Event]) -> EventKind:
    return EventKind(
        measured=bool(event.category & (Category.SENSOR | Category.GEOMETRY)),
        image=issubclass(event, Image),
        setpoint=issubclass(event, Setpoint),
    )


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
    from runtime.tools.tracing.write import write_trace  # when all is over

    order = [node.name for node in supervisor.state.all_nodes]
    try:
        write_trace(spool, path, name=name, clock=supervisor.state.clock.kind, nodes=order)
    except OSError as error:  # a full disk: the run's other results must not go with the trace
        log.error("%s: the trace could not be written: %s", path, error)
