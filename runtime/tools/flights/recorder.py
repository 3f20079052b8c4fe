"""Notes a flight while it is flown, by looking on: an instrument, and hooks on the loop."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from events import Event
from runtime.channels.sender import Sender
from runtime.config.model import Config, NodeSpec
from runtime.node import Node, NodeConfig
from runtime.run.execute import execute
from runtime.run.instruments import Call, Instrument
from runtime.run.supervisor import Supervisor
from runtime.time.lockstep import LockstepLoop
from runtime.time.schedule import Once, Tick, Ticker
from runtime.tools.flights.layout import Action, Flight, Flown, Writer, prune

_REST = 10.0
"""Seconds of the clock for which a flight goes on without ticks: what is on its way at the end, as
an image may be, arrives in a run whose estimator takes long to end."""


def record(config: Config, path: Path) -> None:
    """Fly, and write what there is to say of it into a file, which is complete when this returns.

    Args:
        config: The nodes that fly, on simulated time.
        path: Of the file.

    Raises:
        VisnavError: Something went wrong in the flight.
        KeyboardInterrupt: A signal ended it.
        OSError: It cannot be written.
    """
    rest = NodeSpec(
        name="(rest)", type_name="", on_error="stop", inputs={}, links={}, node=_Rest,
        config=NodeConfig(),
    )  # fmt: skip
    run = msgspec.structs.replace(config.run, digest=False, speed=None)
    config = msgspec.structs.replace(config, run=run, nodes=(*config.nodes, rest))
    with path.open("wb", buffering=1 << 20) as file:
        recorder = _Recorder(writer := Writer(file))
        execute(config, watch=recorder.watch)
        writer.end(recorder.flight())


class _Rest(Node):
    async def on_shutdown(self) -> None:
        """Let time go on, the last node in the file being the first to end."""
        await self.clock.sleep(_REST)


class _Recorder(Instrument):
    def __init__(self, writer: Writer) -> None:
        self._writer = writer
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
        """Return what there is to say; called when it is over."""
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
        if state.conclusions or state.outside or state.after_run:
            self._unfit = "a node of the flight concludes, writes or asks something"
        elif len(state.all_nodes) > len(state.runners):
            self._unfit = "a node of the flight was restarted"
        if self._unfit:
            return Flight(self._unfit, {}, [], {})
        prune(self._occasions)
        return Flight("", nodes, self._occasions, dict(state.environment))

    # What nodes do.

    def wrap_call(self, node: str, what: str, call: Call) -> Call:
        """Note what a node does in a call."""

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
            place, sizes = self._writer.event(event)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            self._unfit, place, sizes = f"{sender.name}: {error}", 0, ()
        action = self._act("send", node, text=sender.name, due=place, sizes=sizes)
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
        host: Any = self._supervisor._host
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
        """Note that something is due later, and return that occasion."""
        occasion = self._new()
        self._act(kind, due=due, later=occasion)
        return occasion

    def _on(self, occasion: int, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function on an occasion."""
        self._begin(occasion)
        self._inside = True
        try:
            return function(*args)
        finally:
            self._inside = False
