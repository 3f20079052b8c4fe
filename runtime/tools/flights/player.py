"""Nodes in the place of those that fly, which send what a flight's nodes have sent."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import mmap
import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

from events import Announcement, Event
from runtime import wire
from runtime.config.model import Config
from runtime.lockstep import LockstepLoop
from runtime.node import Node, senders
from runtime.ports import Output, on
from runtime.schedule import Once, Tick
from runtime.tools.flights.layout import EVENTS, Action, Flight

_DONE: concurrent.futures.Future[None] = concurrent.futures.Future()
_DONE.set_result(None)


class StandIn(Node[Any]):
    """Sends again what a node has sent; made for each node of a flight by `stand_ins`."""

    player: ClassVar[Player]

    async def on_startup(self) -> None:
        """Tick as the node did."""
        self.player.enter(self)
        for what, hz in self.player.flight.tickers[self.name]:
            ticks = self.player.flight.ticks.get(f"{self.name}.{what}", {})
            self.every(hz, functools.partial(self._tick, ticks), what)

    def announce(self) -> Iterable[Announcement]:
        """Announce what the node did."""
        for frame in self.player.flight.announcements[self.name]:
            announcement = pickle.loads(frame)  # noqa: S301  # of this user's own cache
            assert isinstance(announcement, Announcement)
            yield announcement

    @on(Event)
    def hear(self, event: Event) -> bool:
        """Do what the node did on an event of the flight, in its place among the listeners."""
        return self.player.heard(self.name, event)

    async def run(self) -> None:
        """Begin as the node did."""
        occasion = self.player.flight.starts.get(self.name)
        if occasion is not None:
            self.player.play(occasion, 0)

    async def on_shutdown(self) -> None:
        """End: what would come later does not."""
        self.player.leave(self)

    def _tick(self, ticks: dict[int, int], tick: Tick) -> None:
        occasion = ticks.get(tick.index)
        if occasion is not None:
            self.player.play(occasion, -1)


def stand_ins(config: Config, flight: Flight, folder: Path) -> dict[str, type[Node[Any]]]:
    """Return a class in the place of each node of a flight, by the node's name.

    Args:
        config: Of the run.
        flight: That is played again.
        folder: Where its events are.
    """
    player = Player(flight, folder)
    found: dict[str, type[Node[Any]]] = {}
    for spec in config.nodes:
        if spec.name in flight.announcements:
            outputs = {
                port: Output(each.event) for port, each in spec.node.declared.outputs.items()
            }
            found[spec.name] = type(spec.node.__name__, (StandIn,), {**outputs, "player": player})
    return found


class Player:
    """What the stand-ins of a flight have in common: where it stands.

    Args:
        flight: That is played again.
        folder: Where its events are.
    """

    def __init__(self, flight: Flight, folder: Path) -> None:
        self.flight = flight
        self._nodes: dict[str, Node[Any]] = {}
        self._outputs: dict[str, Any] = {}
        self._delivering: list[tuple[Event, dict[int, Action], list[Action]]] = []
        self._frames = memoryview(b"")
        if flight.size:
            with (folder / EVENTS).open("rb") as file:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            mapped.madvise(mmap.MADV_SEQUENTIAL)
            self._frames = memoryview(mapped)

    def enter(self, node: Node[Any]) -> None:
        """Let a node send."""
        if not self._nodes:
            for name, value in self.flight.environment.items():
                node.note_environment(name, value)
        self._nodes[node.name] = node
        self._outputs |= {sender.name: sender for sender in senders(node).values()}

    def leave(self, node: Node[Any]) -> None:
        """Let it send no more."""
        del self._nodes[node.name]

    def play(self, occasion: int, turn: int, first: int = 0) -> None:
        """Do what was done on an occasion.

        Args:
            occasion: Its number.
            turn: Up to which it is done now; the rest follows as the loop turns.
            first: Action to begin with.
        """
        actions = self.flight.occasions[occasion]
        index = first
        while index < len(actions) and actions[index].turn <= turn:
            if actions[index].within < 0:
                self._do(index, actions[index], actions)
            index += 1
        if index < len(actions):
            asyncio.get_running_loop().call_soon(self.play, occasion, turn + 1, index)

    def heard(self, node: str, event: Event) -> bool:
        """Do what a node did while an event was delivered to it; return whether it ends there."""
        for sent, inner, actions in reversed(self._delivering):
            if sent is event:
                for index, action in [(i, a) for i, a in inner.items() if a.node == node]:
                    del inner[index]
                    if action.kind == "handled":
                        return True
                    self._do(index, action, actions)
        return False

    def _do(self, index: int, action: Action, actions: list[Action]) -> None:
        node = self._nodes.get(action.node)
        if node is None:  # it has ended
            return
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        if action.kind == "send":
            begin = int(action.due)
            event = wire.unpack(self._frames[begin : begin + action.number])
            inner = {i: a for i, a in enumerate(actions[index:], index) if a.within == index}
            self._delivering.append((event, inner, actions))
            self._outputs[action.text].send(event)
            for each in list(inner.items()):
                self._do(*each, actions)
            self._delivering.pop()
        elif action.kind == "stop":
            node.stop(action.text)
        elif action.kind == "once":
            entry = Once(functools.partial(self.play, action.number, -1))
            loop.schedule.add(int(action.due), entry)
        elif action.kind == "held":
            future = loop.hold(_DONE, int(action.due))
            future.add_done_callback(lambda _: self.play(action.number, 0))
        elif action.kind == "timer":
            loop.call_at(action.due, self.play, action.number, 0)
