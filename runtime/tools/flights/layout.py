"""What is kept of a flight: one file with its events, what nodes did with them, and a checksum.

The loop gets into nodes by what is due: ticks, timers, work done elsewhere, and the first step of
each `run`. Each of these is an *occasion*, and what nodes do on it are its *actions*: they send
events, and set what brings about later occasions.

    frames       of each event, its pickle and its arrays, each at a multiple of 64 bytes
    flight       the rest, pickled
    u64 LE       where that begins
    16 bytes     XXH3 hash of all before

Pickles keep the very types: a whole number in an event stays one, and has another digest than the
equal float.
"""

from __future__ import annotations

import mmap
import pickle
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import xxhash

from events import Announcement, Event

_ALIGNED = 64
_BEGIN = struct.Struct("<Q")
_CHECKSUM = 16


class Action(NamedTuple):
    """One thing that a node of the flight did.

    Attributes:
        kind: ``send`` an event, say in a handler that it is ``handled``, ``stop`` the run; or set
            what is due later: in the schedule (``once``), work done elsewhere (``held``), a timer
            of asyncio's.
        node: Which did it.
        turn: Turns of the loop since the occasion; -1 before the loop went on.
        inner: What was done while the event was delivered, by those that got it.
        text: The output (``node.port``), or why the run is to stop.
        due: Place of the event in the file; or when the later occasion is due, ns (of a timer: s).
        later: The later occasion.
        sizes: Of the event's frames, bytes.
    """

    kind: Literal["send", "handled", "stop", "once", "held", "timer"]
    node: str
    turn: int
    inner: list[Action]
    text: str = ""
    due: float = 0
    later: int = -1
    sizes: tuple[int, ...] = ()


class Flown(NamedTuple):
    """One node of a flight.

    Attributes:
        announcements: What it announced.
        tickers: By name, in the order of their making, rate and the ticks on which something was
            done, with their occasions.
        start: The occasion on which its `run` begins, if it does.
    """

    announcements: list[Announcement]
    tickers: dict[str, tuple[float, dict[int, int]]]
    start: int | None


class Flight(NamedTuple):
    """A whole flight.

    Attributes:
        unfit: Why it cannot be used; empty if it can.
        nodes: By name.
        occasions: Their actions, in order.
        environment: What the nodes found of the machine.
    """

    unfit: str
    nodes: dict[str, Flown]
    occasions: list[list[Action]]
    environment: dict[str, str]


class Writer:
    """Writes a flight into a file, which is complete when `end` returns."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._hash = xxhash.xxh3_128()
        self._size = 0

    def event(self, event: Event) -> tuple[int, tuple[int, ...]]:
        """Write an event; return its place and the sizes of its frames.

        Raises:
            Exception: Whatever pickling raises for something that is no data.
        """
        arrays: list[pickle.PickleBuffer] = []
        head = pickle.dumps(event, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        frames = [memoryview(head), *(array.raw() for array in arrays)]
        place = self._size
        for frame in frames:
            self._write(frame)
            self._write(bytes(-len(frame) % _ALIGNED))
        return place, tuple(map(len, frames))

    def end(self, flight: Flight) -> None:
        """Write the rest; of a flight that cannot be used, nothing else is kept."""
        if flight.unfit:
            self._file.seek(0)
            self._file.truncate()
            self.__init__(self._file)  # type: ignore[misc]
        begin = self._size
        self._write(pickle.dumps(flight))
        self._write(_BEGIN.pack(begin))
        self._file.write(self._hash.digest())

    def _write(self, data: bytes | memoryview) -> None:
        self._file.write(data)
        self._hash.update(data)
        self._size += len(data)


def opened(path: Path) -> tuple[Flight, memoryview] | None:
    """Return a flight and its file's content; `None` if it cannot be read as it is."""
    if not path.is_file():  # a pipe would wait for ever
        return None
    try:
        with path.open("rb") as file:
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        if xxhash.xxh3_128_digest(content[:-_CHECKSUM]) != content[-_CHECKSUM:]:
            return None
        end = len(content) - _CHECKSUM - _BEGIN.size
        (begin,) = _BEGIN.unpack_from(content, end)
        flight: Flight = pickle.loads(content[begin:end])  # noqa: S301  # of this user's own cache
        for sent in {each.text: each for each in _all(flight.occasions) if each.sizes}.values():
            event_at(content, sent)  # one of each output
    except Exception:  # what was written by other code may raise anything
        return None
    return flight, content


def _all(occasions: Iterable[list[Action]]) -> Iterator[Action]:
    for actions in occasions:
        yield from actions
        yield from _all(each.inner for each in actions if each.inner)


def event_at(content: memoryview, sent: Action) -> Any:
    """Return the event of an action, its arrays read-only in the file's content."""
    place, frames = int(sent.due), []
    for size in sent.sizes:
        frames.append(content[place : place + size])
        place += size + -size % _ALIGNED
    return pickle.loads(frames[0], buffers=frames[1:])  # noqa: S301  # as above


def prune(occasions: list[list[Action]]) -> None:
    """Remove the actions that come to nothing."""
    for actions in reversed(occasions):  # what is due later has a higher number
        _prune(actions, occasions)


def _prune(actions: list[Action], occasions: list[list[Action]]) -> None:
    actions[:] = [each for each in actions if each.later < 0 or occasions[each.later]]
    for each in actions:
        _prune(each.inner, occasions)
