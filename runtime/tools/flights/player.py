"""Nodes in the place of those that fly, which send what a flight's nodes have sent.

If another node ends the run before the flight is over, its ticks end there, but what the flight's
nodes send while the run ends is what they sent at that time when their ticks went on.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
from typing import Any, ClassVar

from events import Announcement, Event
from runtime.channels.ports import Output, on
from runtime.config.model import Config
from runtime.node import Node, senders
from runtime.time.lockstep import LockstepLoop
from runtime.time.schedule import Once, Tick
from runtime.tools.flights.layout import Action, Flight, Flown, event_at

_DONE: concurrent.futures.Future[None] = concurrent.futures.Future()
_DONE.set_result(None)


class StandIn(Node[Any]):
    """Sends again what a node has sent; made for each node of a flight by `stand_ins`."""

    reads_truth = "recording"
    player: ClassVar[Player]

    async def on_startup(self) -> None:
        """Tick as the node did."""
        self.flown = self.player.enter(self)
        for what, (hz, ticks) in self.flown.tickers.items():
            self.every(hz, functools.partial(self._tick, ticks), what)

    def announce(self) -> list[Announcement]:
        """Announce what the node did."""
        return self.flown.announcements

    @on(Event)
    def hear(self, event: Event) -> bool:
        """Do what the node did on an event of the flight, in its place among the listeners."""
        return self.player.heard(self.name, event)

    async def run(self) -> None:
        """Begin as the node did."""
        if self.flown.start is not None:
            self.player.play(self.flown.start, 0)

    async def on_shutdown(self) -> None:
        """End: what would come later does not."""
        self.player.leave(self)

    def _tick(self, ticks: dict[int, int], tick: Tick) -> None:
        if tick.index in ticks:
            self.player.play(ticks[tick.index], -1)


def stand_ins(config: Config, flight: Flight, content: memoryview) -> dict[str, type[Node[Any]]]:
    """Return a class in the place of each node of a flight, by the node's name.

    Args:
        config: Of the run.
        flight: That is played again.
        content: Of its file.
    """
    player = Player(flight, content)
    found: dict[str, type[Node[Any]]] = {}
    for spec in config.nodes:
        if spec.name in flight.nodes:
            outputs = {name: Output(o.event) for name, o in spec.node.declared.outputs.items()}
            found[spec.name] = type(spec.node.__name__, (StandIn,), {**outputs, "player": player})
    return found


class Player:
    """What the stand-ins of a flight have in common: where it stands.

    Args:
        flight: That is played again.
        content: Of its file.
    """

    def __init__(self, flight: Flight, content: memoryview) -> None:
        self._flight = flight
        self._content = content
        self._nodes: dict[str, Node[Any]] = {}
        self._outputs: dict[str, Any] = {}
        self._delivering: list[tuple[Event, list[Action]]] = []

    def enter(self, node: Node[Any]) -> Flown:
        """Let a node send, and return what there is of it."""
        if not self._nodes:
            for name, value in self._flight.environment.items():
                node.note_environment(name, value)
        self._nodes[node.name] = node
        self._outputs |= {sender.name: sender for sender in senders(node).values()}
        return self._flight.nodes[node.name]

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
        actions = self._flight.occasions[occasion]
        while first < len(actions) and actions[first].turn <= turn:
            self._do(actions[first])
            first += 1
        if first < len(actions):
            asyncio.get_running_loop().call_soon(self.play, occasion, turn + 1, first)

    def heard(self, node: str, event: Event) -> bool:
        """Do what a node did while an event was delivered to it; return whether it ends there."""
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
