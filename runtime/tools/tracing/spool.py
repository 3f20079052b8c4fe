"""A file of notes, written during a run to bound the memory.

A thread encodes a list of notes at a time, which is short enough not to be felt on the loop. What
the notes mean is in `runtime.tools.tracing.record`.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from events import Category, Event, Image, Setpoint

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
