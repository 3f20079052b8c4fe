"""A flight: recorded while flown, kept in a file, and sent again by stand-ins for its nodes.

If another node ends the run before the flight is over, its ticks end there, but what the flight's
nodes send while the run ends is what they sent at that time when their ticks went on.

The loop gets into nodes by what is due: ticks, timers, work done elsewhere, and the first step of
each `run`. Each of these is an *occasion*, and what nodes do on it are its *actions*: they send
events, and set what brings about later occasions. So of things due at one time, those of the flight
and those of other nodes come in the same order again, which no list of events and times could tell.

    events       each pickled
    flight       the rest, pickled
    u64 LE       where that begins
    16 bytes     XXH3 hash of all before

Pickles keep the very types: a whole number in an event stays one, and has another digest than the
equal float.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import mmap
import pickle
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, ClassVar, Literal, NamedTuple

import msgspec
import xxhash

from events import Announcement, Event
from runtime.channels.ports import Output, on
from runtime.channels.sender import Sender
from runtime.config.model import Config, NodeSpec
from runtime.node import Node, NodeConfig, senders
from runtime.run.execute import execute
from runtime.run.instruments import Call, Instrument
from runtime.run.supervisor import Supervisor
from runtime.time.lockstep import LockstepLoop
from runtime.time.schedule import Once, Tick, Ticker

_BEGIN = struct.Struct("<Q")
_CHECKSUM = 16
_REST = 10.0
"""Seconds of the clock for a flight to go on without ticks: images on their way still arrive."""


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
    """

    kind: Literal["send", "handled", "stop", "once", "held", "timer"]
    node: str
    turn: int
    inner: list[Action]
    text: str = ""
    due: float = 0
    later: int = -1


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


class Flight(msgspec.Struct):
    """A whole flight; `unfit` is why it cannot be used.

    Attributes:
        occasions: Their actions, in order.
        environment: What the nodes found of the machine.
        places: Where in the file an event of each output is.
    """

    unfit: str
    nodes: dict[str, Flown] = {}
    occasions: list[list[Action]] = []
    environment: dict[str, str] = {}
    places: dict[str, int] = {}


def put(file: IO[bytes], what: Any) -> int:
    """Write an event, or another object that can be pickled; return its place."""
    place = file.tell()
    pickle.dump(what, file, pickle.HIGHEST_PROTOCOL)
    return place


def event_at(content: memoryview, place: int) -> Any:
    """Return the event at a place of a file's content."""
    return pickle.loads(content[place:])  # noqa: S301  # of this user's own cache


def opened(path: Path) -> tuple[Flight, memoryview] | None:
    """Return a flight and its file's content; `None` if missing or not readable."""
    if not path.is_file():  # a pipe would wait for ever
        return None
    try:
        content = _mapped(path)
        if xxhash.xxh3_128_digest(content[:-_CHECKSUM]) != content[-_CHECKSUM:]:
            return None
        (begin,) = _BEGIN.unpack_from(content, len(content) - _CHECKSUM - _BEGIN.size)
        flight: Flight = event_at(content, begin)
        for place in flight.places.values():
            event_at(content, place)
    except Exception:  # what was written by other code may raise anything
        return None
    return flight, content


def _mapped(path: Path) -> memoryview:
    with path.open("rb") as file:
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def record(config: Config, path: Path) -> None:
    """Fly, and write the flight into a file, complete on return.

    Raises:
        VisnavError: The flight failed.
        KeyboardInterrupt: A signal ended it.
        OSError: The file cannot be written.
    """
    rest = NodeSpec(
        name="(rest)", type_name="", on_error="stop", inputs={}, links={}, node=_Rest,
        config=NodeConfig(),
    )  # fmt: skip
    run = msgspec.structs.replace(config.run, digest=False, speed=None)
    config = msgspec.structs.replace(config, run=run, nodes=(*config.nodes, rest))
    with path.open("wb", buffering=1 << 20) as file:
        recorder = _Recorder(file)
        execute(config, watch=recorder.watch)
        flight = recorder.flight()
        if flight.unfit:  # without any events
            file.seek(0)
            file.truncate()
        file.write(_BEGIN.pack(put(file, flight)))
        file.flush()
        file.write(xxhash.xxh3_128_digest(_mapped(path)))


class _Rest(Node):
    async def on_shutdown(self) -> None:
        """Let time go on, the last node in the file being the first to end."""
        await self.clock.sleep(_REST)


class _Recorder(Instrument):
    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._places: dict[str, int] = {}
        self._occasions: list[list[Action]] = []
        self._events: list[tuple[Event, list[Action]]] = []  # of this occasion
        self._actions: list[Action] = []  # of this occasion
        self._turn = self._begun = 0
        self._inside = False
        self._doing: list[tuple[str, list[Action] | None]] = []  # node, and within which event
        self._ticks: dict[str, dict[int, int]] = {}
        self._starts: dict[str, int] = {}
        self._unfit = ""
        self._supervisor: Supervisor
        self.event_sent = self._sent

    @contextlib.contextmanager
    def watch(self, supervisor: Supervisor) -> Iterator[None]:
        """Look at a run, from within its loop."""
        self._supervisor = supervisor
        supervisor.instruments.attach(self)
        yield

    def flight(self) -> Flight:
        """Return the flight; called after its end."""
        state = self._supervisor.state
        if state.stop_requested:  # whatever was to follow is not wanted either
            raise KeyboardInterrupt
        nodes = {
            name: Flown([], {}, self._starts.get(name))
            for name in state.runners
            if name != "(rest)"
        }
        for each in state.announcements:
            if (node := each.source.partition("/")[0]) in nodes:
                nodes[node].announcements.append(each)
            else:
                self._unfit = f"{each.source} is announced in another's name"
        for name, ticker in state.tickers.items():
            node, _, what = name.partition(".")
            nodes[node].tickers[what] = ticker.hz, self._ticks.get(name, {})
        if state.conclusions or state.flights or state.outside or state.afterwards:
            self._unfit = "a node of the flight concludes, writes or asks something"
        elif len(state.all_nodes) > len(state.runners):
            self._unfit = "a node of the flight was restarted"
        if self._unfit:
            return Flight(self._unfit)
        for actions in reversed(self._occasions):  # what is due later has a higher number
            self._prune(actions)
        return Flight("", nodes, self._occasions, dict(state.environment), self._places)

    def _prune(self, actions: list[Action]) -> None:
        """Remove the actions leading only to empty occasions."""
        actions[:] = [each for each in actions if each.later < 0 or self._occasions[each.later]]
        for each in actions:
            self._prune(each.inner)

    # What nodes do.

    def wrap_call(self, node: str, what: str, call: Call) -> Call:
        """Note the actions of a node in a call."""

        def wrapped(given: Any) -> Any:
            within = None
            ticks = isinstance(given, Tick)
            if ticks:
                self._ticks.setdefault(f"{node}.{what}", {})[given.index] = self._begin(self._new())
            elif isinstance(given, Event):
                within = next((i for each, i in reversed(self._events) if each is given), None)
            elif what == "run" and node not in self._starts:
                self._starts[node] = self._begin(self._new())
            self._inside = self._inside or ticks
            self._doing.append((node, within))
            try:
                result = call(given)
                if result is True and isinstance(given, Event):
                    self._act("handled")
                return result
            finally:
                self._doing.pop()
                self._inside = self._inside and not ticks

        return wrapped

    def _sent(self, sender: Sender[Any] | None, event: Event) -> None:
        if sender is None:
            return
        node = sender.name.partition(".")[0]
        runner = self._supervisor.state.runners[node]
        if runner.shutting_down or runner.phase == "on_end":  # when that is depends on all nodes
            self._unfit = f"{node} sends something at its end"
        try:
            self._places[sender.name] = place = put(self._file, event)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            self._unfit, place = f"{sender.name}: {error}", 0
        action = self._act("send", node, text=sender.name, due=place)
        self._events.append((event, action.inner))

    def _act(self, kind: Any, node: str = "", **more: Any) -> Action:
        own, within = self._doing[-1] if self._doing else (node, None)
        turn = -1 if self._inside else self._turn - self._begun
        action = Action(kind, node or own, turn, [], **more)
        (self._actions if within is None else within).append(action)
        return action

    # Occasions.

    def _new(self) -> int:
        if not self._occasions:  # what was set before the first is set anew in each run
            self._hook()
        self._occasions.append([])
        return len(self._occasions) - 1

    def _begin(self, occasion: int) -> int:
        self._actions, self._begun = self._occasions[occasion], self._turn
        self._events.clear()
        return occasion

    def _hook(self) -> None:
        loop = asyncio.get_running_loop()
        host: Any = self._supervisor.state
        assert isinstance(loop, LockstepLoop)
        schedule: Any = loop.schedule
        stop, add, hold, call_at = host.stop, schedule.add, loop.hold, loop.call_at
        run_once = loop._run_once  # type: ignore[attr-defined]

        def turned() -> None:
            self._turn += 1
            run_once()

        def stopped(node: Any, reason: str) -> None:
            self._act("stop", text=reason)
            stop(node, reason)

        def added(due: int, entry: Any) -> None:
            if isinstance(entry, Ticker):
                self._unfit = "a node of the flight begins to tick in the middle"
            else:
                fire = functools.partial(self._on, self._later("once", due), entry.fire, due, due)
                entry = Once(fire)
            add(due, entry)

        def held(work: Any, due: int) -> asyncio.Future[Any]:
            future, later = hold(work, due), self._later("held", due)
            future.add_done_callback(lambda f: None if f.cancelled() else self._begin(later))
            return future

        def called(when: float, call: Callable[..., Any], *args: Any, context: Any = None) -> Any:
            return call_at(when, self._on, self._later("timer", when), call, *args, context=context)

        patched: Any = loop
        host.stop, schedule.add, patched.hold, patched.call_at = stopped, added, held, called
        patched._run_once = turned

    def _later(self, kind: str, due: float) -> int:
        occasion = self._new()
        self._act(kind, due=due, later=occasion)
        return occasion

    def _on(self, occasion: int, function: Callable[..., Any], *args: Any) -> Any:
        self._begin(occasion)
        self._inside = True
        try:
            return function(*args)
        finally:
            self._inside = False


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
            event, inner = event_at(self._content, int(action.due)), [*action.inner]
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
