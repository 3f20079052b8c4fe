"""An instrument to note a run's steps and events: no more than a tuple each on the loop.

The notes go into a file during the run, to bound the memory. A thread encodes a list of notes at a
time, which is short enough not to be felt on the loop.

Causes of events, from a sensor's measurement through nodes to a set-point, are not declared by
nodes; they are inferred by three rules, the most reliable first:

1. An event has the stamp of one that its node received: an estimate has that of its image.
2. Its node sent it while it handled another event.
3. Its node had received another event: a controller with a rate of its own uses the newest.

The third rule is a guess, and is marked as *held*: the latency of such a path is the age of the
newest event that the node could have used.
"""

from __future__ import annotations

import concurrent.futures
import logging
import queue
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from events import Category, Event, Image, Setpoint
from runtime.channels.sender import Sender, Tap
from runtime.logs import RunThread
from runtime.run.instruments import Call, Instrument
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
        cause_id: The `id` of the event that the step which sent it was handling; 0 if none.
    """

    time: int
    run: int
    sender: str
    event: str
    source: str
    stamp: int
    identity: int
    cause_id: int


class ClockRate(NamedTuple):
    """Relation of the run's clock to real time; `run` of a note is then real time, too.

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
        receivers: Nodes that receive events of a sender, type and source.
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
        self._thread = RunThread(target=self._write, name="trace", daemon=True)
        self._thread.start()

    def add(self, notes: list[tuple[Any, ...]]) -> None:
        """Write a list of notes, ordered by time."""
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
            except OSError as error:  # a full disk must not end the run
                self.failed = error
                log.warning("no trace from here on: %s", error)

    def _drained(self) -> list[tuple[Any, ...]]:
        notes = []
        while self.beside:
            notes.append(self.beside.popleft())
        return notes

    def _append(self, notes: list[tuple[Any, ...]]) -> None:
        content = self._encode([self._plain(n) if n[0] == "event" else n for n in notes])
        remaining = memoryview(len(content).to_bytes(_LENGTH_BYTES, "little") + content)
        while remaining:
            remaining = remaining[self._file.write(remaining) :]

    def _plain(self, note: tuple[Any, ...]) -> tuple[Any, ...]:
        _, time, run, sender, event, source, stamp, identity, cause, listeners = note
        name = "run.announced" if sender is None else sender.name
        key = (name, event.__name__, source)
        if key not in self.receivers:
            nodes = (
                listener.node for listener in listeners or () if listener.receives(event, source)
            )
            self.receivers[key] = tuple(dict.fromkeys(nodes))
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
            # A tick may have the `id` of a deleted event.
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
        submitted, add_note = time.perf_counter_ns(), self.beside.append

        def noting() -> Any:
            begin = time.perf_counter_ns()
            try:
                return call()
            finally:
                thread = threading.current_thread().name
                add_note(("thread", thread, node, name, submitted, begin, time.perf_counter_ns()))

        return noting

    def worker_called(
        self, process: str, method: str, answer: concurrent.futures.Future[Any]
    ) -> None:
        """Record a worker's call once answered."""
        asked = time.perf_counter_ns()
        answer.add_done_callback(
            lambda _: self.beside.append(("worker", process, method, asked, time.perf_counter_ns()))
        )

    def close(self) -> None:
        """Write the remaining notes, while the run's clock still runs."""
        if isinstance(self._clock, RealClock):
            real, run, speed = time.perf_counter_ns(), self._clock.now(), self._clock.speed
            self._spool.rate = ClockRate(round(real - run / speed), speed)
        self._flush()

    def _flush(self) -> None:
        self._spool.add(self._notes.copy())
        self._notes.clear()


REMEMBERED = 512  # how many stamps of received events are kept per node
IDENTITIES = 8192  # how many events are kept by identity

Relation = Literal["begins", "follows", "holds"]


class SentEvent(msgspec.Struct, eq=False):
    """An event and its cause, an earlier event.

    Attributes:
        time: Of `time.perf_counter_ns`, when it was sent.
        node: Sender.
        from_camera: Whether its path begins with a camera.
        relation: ``begins`` a path, ``follows`` from `cause`, or ``holds`` it at best.
        cause: The event that it follows from.
    """

    time: int
    run: int
    node: str
    event: str
    source: str
    stamp: int
    from_camera: bool = False
    relation: Relation = "begins"
    cause: SentEvent | None = None

    def path(self) -> list[SentEvent]:
        """Return all events from the sensor's event to this."""
        events: list[SentEvent] = []
        event: SentEvent | None = self
        while event is not None:
            events.append(event)
            event = event.cause
        return events[::-1]


class _ReceivedEvents:
    def __init__(self) -> None:
        self.by_stamp: OrderedDict[int, list[SentEvent]] = OrderedDict()
        self.newest: SentEvent | None = None

    def add(self, sent: SentEvent) -> None:
        self.by_stamp.setdefault(sent.stamp, []).append(sent)
        if len(self.by_stamp) > REMEMBERED:
            self.by_stamp.popitem(last=False)
        if sent.from_camera or self.newest is None or not self.newest.from_camera:
            self.newest = sent

    def of_stamp(self, stamp: int) -> Iterator[SentEvent]:
        """Yield the events with this stamp, the most likely cause first."""
        yield from sorted(
            self.by_stamp.get(stamp, ()), key=lambda s: (s.from_camera, s.time), reverse=True
        )


class Causes:
    """Inference of each event's cause, event by event in the order of sending.

    Args:
        receivers: The nodes that receive events of a sender, type and source.
    """

    def __init__(
        self,
        kinds: Mapping[str, EventKind],
        receivers: Mapping[tuple[str, str, str], tuple[str, ...]],
    ) -> None:
        self._kinds = kinds
        self._receivers = receivers
        self._received: dict[str, _ReceivedEvents] = {}
        self._by_identity: OrderedDict[int, tuple[SentEvent, tuple[str, ...]]] = OrderedDict()
        """Events with their receiving nodes, by `id`."""

    def add(self, note: EventNote) -> SentEvent:
        """Add the next event, and return the event with its cause."""
        node, kind = note.sender.partition(".")[0], self._kinds[note.event]
        sent = SentEvent(note.time, note.run, node, note.event, note.source, note.stamp)
        # An `id` may belong to an earlier, deleted event.
        cause, receivers_of_cause = self._by_identity.get(note.cause_id, (None, ()))
        self._trace_back(sent, kind, cause if node in receivers_of_cause else None)
        sent.from_camera = kind.image if sent.cause is None else sent.cause.from_camera
        receivers = self._receivers.get((note.sender, note.event, note.source), ())
        self._by_identity[note.identity] = sent, receivers
        self._by_identity.move_to_end(note.identity)
        if len(self._by_identity) > IDENTITIES:
            self._by_identity.popitem(last=False)
        if not kind.setpoint and (kind.measured or sent.cause is not None):
            for receiver in receivers:
                if receiver != node:
                    self._received.setdefault(receiver, _ReceivedEvents()).add(sent)
        return sent

    def _trace_back(self, sent: SentEvent, kind: EventKind, candidate: SentEvent | None) -> None:
        past = self._received.get(sent.node) or _ReceivedEvents()
        if candidate is not None and (
            candidate.node == sent.node or not self._leads_anywhere(candidate)
        ):
            candidate = None
        candidates: list[SentEvent] = []
        if not kind.setpoint:  # a set-point's stamp is its time of sending
            if candidate is not None and candidate.stamp == sent.stamp:
                candidates.append(candidate)
            candidates += past.of_stamp(sent.stamp)
        if candidate is not None and not kind.measured:
            candidates.append(candidate)
        for cause in candidates:
            if _passes(cause, sent.node):
                sent.cause, sent.relation = cause, "follows"
                return
        newest = past.newest
        if newest is not None and not kind.measured and _passes(newest, sent.node):
            sent.cause, sent.relation = newest, "holds"

    def _leads_anywhere(self, sent: SentEvent) -> bool:
        kind = self._kinds[sent.event]
        return not kind.setpoint and (kind.measured or sent.cause is not None)


def _passes(sent: SentEvent, node: str) -> bool:
    """Return whether a path can go on to a node: each node is on a path only once."""
    return all(step.node != node for step in sent.path())
