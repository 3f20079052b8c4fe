"""Stand-ins for the nodes of a flight, to send its recorded events again.

If another node ends the run before the flight is over, its ticks end there, but what the flight's
nodes send while the run ends is what they sent at that time when their ticks went on.

What is kept of a flight: one file with its events, what nodes did with them, and a checksum.

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

import asyncio
import concurrent.futures
import functools
import mmap
import pickle
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, ClassVar, Literal, NamedTuple

import xxhash

from events import Announcement, Event
from runtime.channels.ports import Output, on
from runtime.config.model import Config
from runtime.node import Node, senders
from runtime.time.lockstep import LockstepLoop
from runtime.time.schedule import Once, Tick

_ALIGNED = 64
_BEGIN = struct.Struct("<Q")
_CHECKSUM = 16


class Action(NamedTuple):
    """An action of a node in a flight.

    Attributes:
        kind: ``send`` an event, say in a handler that it is ``handled``, ``stop`` the run; or set
            what is due later: in the schedule (``once``), work done elsewhere (``held``), a timer
            of asyncio's.
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
    """A node of a flight.

    Attributes:
        tickers: By name, in the order of their making, rate and the ticks on which something was
            done, with their occasions.
        start: The occasion on which its `run` begins, if it does.
    """

    announcements: list[Announcement]
    tickers: dict[str, tuple[float, dict[int, int]]]
    start: int | None


class Flight(NamedTuple):
    """A whole flight; `unfit` is why it cannot be used.

    Attributes:
        occasions: Their actions, in order.
        environment: What the nodes found of the machine.
    """

    unfit: str
    nodes: dict[str, Flown]
    occasions: list[list[Action]]
    environment: dict[str, str]


class Writer:
    """Writer of a flight's file, complete when `end` returns."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._hash = xxhash.xxh3_128()
        self._size = 0

    def event(self, event: Event) -> tuple[int, tuple[int, ...]]:
        """Write an event that can be pickled; return its place and the sizes of its frames."""
        arrays: list[pickle.PickleBuffer] = []
        head = pickle.dumps(event, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        frames = [memoryview(head), *(array.raw() for array in arrays)]
        place = self._size
        for frame in frames:
            self._write(frame)
            self._write(bytes(-len(frame) % _ALIGNED))
        return place, tuple(map(len, frames))

    def end(self, flight: Flight) -> None:
        """Write the flight after its events; of an unusable flight, without any events."""
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
    """Return a flight and its file's content; `None` if missing or not readable."""
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
    """Remove the actions leading only to empty occasions."""
    for actions in reversed(occasions):  # what is due later has a higher number
        _prune(actions, occasions)


def _prune(actions: list[Action], occasions: list[list[Action]]) -> None:
    actions[:] = [each for each in actions if each.later < 0 or occasions[each.later]]
    for each in actions:
        _prune(each.inner, occasions)


_DONE: concurrent.futures.Future[None] = concurrent.futures.Future()
_DONE.set_result(None)


class StandIn(Node[Any]):
    """Node to repeat the events of a recorded node; made by `stand_ins` for each."""

    reads_truth = "recording"
    player: ClassVar[Player]

    async def on_startup(self) -> None:
        """Tick as the node did."""
        self.flown = self.player.enter(self)
        for what, (hz, ticks) in self.flown.tickers.items():
            self.every(hz, functools.partial(self._tick, ticks), what)

    def announce(self) -> list[Announcement]:
        """Return the announcements of the recorded node."""
        return self.flown.announcements

    @on(Event)
    def hear(self, event: Event) -> bool:
        """Repeat the node's actions on an event, in its place among the listeners."""
        return self.player.heard(self.name, event)

    async def run(self) -> None:
        """Begin as the node did."""
        if self.flown.start is not None:
            self.player.play(self.flown.start, 0)

    async def on_shutdown(self) -> None:
        """End the playback of this node: later actions are left out."""
        self.player.leave(self)

    def _tick(self, ticks: dict[int, int], tick: Tick) -> None:
        if tick.index in ticks:
            self.player.play(ticks[tick.index], -1)


def stand_ins(config: Config, flight: Flight, content: memoryview) -> dict[str, type[Node[Any]]]:
    """Return a class in the place of each node of a flight, by the node's name."""
    player = Player(flight, content)
    found: dict[str, type[Node[Any]]] = {}
    for spec in config.nodes:
        if spec.name in flight.nodes:
            outputs = {name: Output(o.event) for name, o in spec.node.declared.outputs.items()}
            found[spec.name] = type(spec.node.__name__, (StandIn,), {**outputs, "player": player})
    return found


class Player:
    """Playback of a flight, shared by its stand-ins."""

    def __init__(self, flight: Flight, content: memoryview) -> None:
        self._flight = flight
        self._content = content
        self._nodes: dict[str, Node[Any]] = {}
        self._outputs: dict[str, Any] = {}
        self._delivering: list[tuple[Event, list[Action]]] = []

    def enter(self, node: Node[Any]) -> Flown:
        """Add a node as sender, and return its record."""
        if not self._nodes:
            for name, value in self._flight.environment.items():
                node.note_environment(name, value)
        self._nodes[node.name] = node
        self._outputs |= {sender.name: sender for sender in senders(node).values()}
        return self._flight.nodes[node.name]

    def leave(self, node: Node[Any]) -> None:
        """Remove a node as sender; its later actions are left out."""
        del self._nodes[node.name]

    def play(self, occasion: int, turn: int, first: int = 0) -> None:
        """Play the actions of an occasion up to a turn; the rest follows as the loop turns."""
        actions = self._flight.occasions[occasion]
        while first < len(actions) and actions[first].turn <= turn:
            self._do(actions[first])
            first += 1
        if first < len(actions):
            asyncio.get_running_loop().call_soon(self.play, occasion, turn + 1, first)

    def heard(self, node: str, event: Event) -> bool:
        """Play a node's actions on a delivered event; tell whether the delivery ends."""
        for sent, inner in reversed(self._delivering):
            if sent is event:
                for action in [each for each in inner if each.node == node]:
                    inner.remove(action)
                    if action.kind == "handled":
                        return True
                    self._do(action)
        return False

    def _do(self, action: Action) -> None:
        node = self._nodes.get(action.node)
        if node is None:  # it has ended
            return
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        if action.kind == "send":
            event, inner = event_at(self._content, action), [*action.inner]
            self._delivering.append((event, inner))
            self._outputs[action.text].send(event)
            for each in [*inner]:
                self._do(each)
            self._delivering.pop()
        elif action.kind == "stop":
            node.stop(action.text)
        elif action.kind == "once":
            entry = Once(functools.partial(self.play, action.later, -1))
            loop.schedule.add(int(action.due), entry)
        elif action.kind == "held":
            future = loop.hold(_DONE, int(action.due))
            future.add_done_callback(lambda _: self.play(action.later, 0))
        elif action.kind == "timer":
            loop.call_at(action.due, self.play, action.later, 0)
