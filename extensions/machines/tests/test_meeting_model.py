"""Whatever is late, cut, or killed while processes meet, in the end all begin, and know all."""

from __future__ import annotations

import asyncio
import itertools
from collections import defaultdict, deque
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from events import Image
from extensions.machines.tests import samples
from runtime.channels.sender import Listener
from visnav_machines.handshake import Handshakes
from visnav_machines.joint import JointStart
from visnav_machines.membership import Membership, Waiting
from visnav_machines.messages import FirstUpdate
from visnav_machines.peers import Peers
from visnav_machines.session import derive

NODES = ("asker", "one", "other")
CONFIG = samples.settings(
    ("asker", "Asker", {"on_error": "restart"}),
    ("one", "Answerer", {"on_error": "restart"}),
    ("other", "Answerer", {"on_error": "restart"}),
    shared=False,
    meet="x/y",
)
KEY = derive(b"secret", "run", "test")


class Still:
    """A clock that is neither that of lockstep nor that of real time."""

    def now(self) -> int:
        return 0


def absent(membership: Membership) -> set[str]:
    """Return the nodes that are awaited before the first update."""
    return {node for seat in membership.seats.values() if seat.absent for node in seat.nodes}


class Machine:
    """One process: its part in the meeting, step by step."""

    def __init__(self, wire: Wire, node: str, id_: str) -> None:
        self.id = id_
        self.node = node
        self.begun = False
        self.heard: list[str] = []
        self.steps = asyncio.Semaphore(0)
        self.peers = Peers(CONFIG, [node], Still(), self.stop, self.connect)  # type: ignore[arg-type]
        self.membership = self.peers._membership
        self.membership.meet = self.membership.numbers  # type: ignore[method-assign]
        self._wire = wire
        self.handshakes = Handshakes(KEY, self, self.membership)  # type: ignore[arg-type]
        self.membership._handshakes = self.handshakes
        self.task = asyncio.get_running_loop().create_task(self._start())

    async def _start(self) -> None:
        await self.peers.meet()
        await self.steps.acquire()
        offer = samples.Offer(stamp=0, source=self.node, rate=1.0)
        self.heard = [known.source for known in await self.peers.announce({self.node: [offer]})]
        await self.steps.acquire()
        self.connect()
        reference = await self.peers._start.wait_for_first_update()
        assert self.peers._remote is not None
        assert {*self.peers._remote._inputs} >= {m.number for m in self.membership.present()}
        assert reference is not None or not absent(self.membership)
        await self.steps.acquire()  # in real time there is a while to the first update
        lost = absent(self.membership)
        self.connect()
        self.peers.nodes_run()
        assert {*self.membership.hello.lost} >= lost
        self.begun = True

    # In the place of a run, and of a session with Zenoh.

    def connect(self) -> None:
        listener = Listener(self.node, lambda _: None, (samples.Asked, Image))
        self.peers.connect([listener], lambda *_: None)

    def stop(self, reason: str, *_: Any, **__: Any) -> None:
        raise AssertionError(reason)

    def send(self, other: str, message: bytes, payload: bytes) -> None:
        self._wire.under_way[self.id, other].append((message, payload))


class Wire:
    """Three machines, who sees whom, and what is on its way."""

    def __init__(self) -> None:
        self.under_way: dict[tuple[str, str], deque[tuple[bytes, bytes]]] = defaultdict(deque)
        self.sees: set[tuple[str, str]] = set()
        self._ids = map(str, itertools.count())
        self.machines = {node: Machine(self, node, next(self._ids)) for node in NODES}
        for one, other in itertools.permutations(NODES, 2):
            self.see(one, other)

    def deliver(self, sender: str, to: str) -> None:
        a, b = self.machines[sender], self.machines[to]
        if self.under_way[a.id, b.id]:
            self.see(to, sender)  # of whom a message comes, that it is there was heard before
            b.membership._receive(a.id, *self.under_way[a.id, b.id].popleft())

    def see(self, one: str, other: str) -> None:
        a, b = self.machines[one], self.machines[other]
        if one != other and (a.id, b.id) not in self.sees:
            self.sees.add((a.id, b.id))
            a.handshakes.on_presence(b.id, True)

    def cut(self, one: str, other: str) -> None:
        """One loses sight of the other; what is on the way to it is lost."""
        a, b = self.machines[one], self.machines[other]
        self.under_way[b.id, a.id].clear()
        if (a.id, b.id) in self.sees:
            self.sees.discard((a.id, b.id))
            a.handshakes.on_presence(b.id, False)

    async def kill(self, node: str) -> None:
        """Start a process again, with all that it was and said gone."""
        self.machines[node].task.cancel()
        for other in NODES:
            if other != node:
                self.cut(other, node)
        self.machines[node] = Machine(self, node, next(self._ids))
        await asyncio.sleep(0)

    async def do(self, what: str, one: str, other: str) -> None:
        match what:
            case "step":
                self.machines[one].steps.release()
            case "kill":
                await self.kill(one)
            case "round":
                await self.round()
            case "greet":
                self.machines[one].handshakes.greet_again()
            case "drain":
                for _ in range(len(self.under_way[self.machines[one].id, self.machines[other].id])):
                    await self.do("deliver", one, other)
            case "deliver" | "see" | "cut" if one != other:
                getattr(self, what)(one, other)
        for _ in range(8):  # of what tasks do, each part takes one turn of the loop
            await asyncio.sleep(0)

    async def round(self) -> None:
        """Let everything that is on its way arrive."""
        for link, messages in list(self.under_way.items()):
            for _ in range(len(messages)):
                for one, other in itertools.permutations(NODES, 2):
                    if link == (self.machines[one].id, self.machines[other].id):
                        await self.do("deliver", one, other)

    async def settle(self) -> None:
        """Let all see one another, and everything arrive."""
        after = 0  # rounds since all began: links that were cut are made anew in some
        for _ in range(100):
            after += all(machine.begun for machine in self.machines.values())
            if after == 6:
                return
            for machine in self.machines.values():
                machine.steps.release()
                machine.handshakes.greet_again()
            for one, other in itertools.permutations(NODES, 2):
                await self.do("see", one, other)
                while self.under_way[self.machines[one].id, self.machines[other].id]:
                    await self.do("deliver", one, other)


WHO = st.sampled_from(NODES)
WHAT = ["round"] * 2 + ["step"] * 3 + ["drain"] * 4
WHAT += ["deliver", "cut", "see"] * 2 + ["kill", "greet"]
OPS = st.lists(st.tuples(st.sampled_from(WHAT), WHO, WHO), max_size=25)
STEPS = st.tuples(*[st.integers(0, 3)] * 3)
"""How far each process is before all that: met, announced, ready, begun."""


def check(wire: Wire) -> None:
    for node, machine in wire.machines.items():
        peers = machine.peers
        assert not machine.task.done() or machine.task.exception() is None
        assert machine.begun, f"{node} has not begun"
        assert machine.heard == [*NODES]
        assert machine.membership.complete()
        assert not absent(machine.membership)
        assert not any(m.returning for m in machine.membership.present()), (
            f"{node} has not taken all back"
        )
        assert peers._remote is not None
        wanted = peers._remote._inputs
        assert len(wanted) == 2
        assert all(wanted.values()), f"{node} does not know what others want"


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(STEPS, OPS)
@example((3, 3, 3), [("kill", "one", "one")])
@example((3, 3, 3), [("cut", "one", "asker"), ("cut", "asker", "one")])
@example((2, 2, 2), [("kill", "other", "other")])
@example((2, 2, 1), [("kill", "other", "other"), ("see", "asker", "other")])
def test_all_begin_whatever_happens(
    steps: tuple[int, ...], ops: list[tuple[str, str, str]]
) -> None:
    """Also who is lost in the run is taken back."""

    async def main() -> None:
        wire = Wire()
        for step in range(4):
            while any(wire.under_way.values()):
                await wire.round()
            for machine, most in zip(wire.machines.values(), steps, strict=True):
                await wire.do("step" if most > step else "look", machine.node, "")
        for op in ops:
            await wire.do(*op)
        await wire.settle()
        check(wire)
        for machine in wire.machines.values():
            for member in machine.handshakes.members():
                member.outbox.close()

    asyncio.run(main())


def test_who_is_back_before_it_was_missed_is_counted_once() -> None:
    """Before all were there, the process that it was is not waited for, nor heard."""

    async def main() -> None:
        wire = Wire()
        for _ in range(4):
            await wire.do("drain", "asker", "one")
            await wire.do("drain", "one", "asker")
        wire.machines["one"].task.cancel()
        wire.machines["one"] = Machine(wire, "one", "back")
        await wire.settle()
        check(wire)

    asyncio.run(main())


@pytest.mark.parametrize(
    ("told", "over", "begins"), [(True, "gone", True), (False, "gone", False), (True, "", True)]
)
def test_who_was_told_that_the_run_begins_waits_for_nobody_who_is_gone(
    told: bool, over: str, begins: bool
) -> None:
    """It may have stood still while the others began, and ended; the loss is one of the run."""
    membership: Any = SimpleNamespace(present=list, here=(), seats={}, waiting=Waiting({}, 1.0))
    reference: Any = SimpleNamespace(over=over, first_update=FirstUpdate(0, 0) if told else None)
    start = JointStart(membership, Still(), 1.0)  # type: ignore[arg-type]
    assert asyncio.run(start._decided(reference)) is begins


class Token:
    """In the place of a holder of the turn: notes what is asked of it."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, list[int]]] = []

    def suspend(self) -> None:
        self.asked.append(("suspend", []))

    def gather(self, numbers: list[int], ids: list[str], new: list[int]) -> None:
        assert len(ids) == len(numbers)
        self.asked.append(("gather", sorted(new)))


def test_in_lockstep_time_stands_until_all_that_were_lost_are_back() -> None:
    """Also if one comes back, and is lost again before it is ready."""

    async def main() -> None:
        wire = Wire()
        await wire.settle()
        peers = wire.machines["asker"].peers
        token = Token()
        peers._token, peers._loop = token, wire  # type: ignore[assignment]
        await wire.kill("one")
        await wire.kill("other")
        await wire.do("see", "asker", "one")
        for _ in range(3):
            await wire.do("see", "one", "asker")
            await wire.round()
        (one,) = peers._membership.present()
        assert one.number == 1
        assert one.returning
        await wire.kill("one")
        assert {what for what, _ in token.asked} == {"suspend"}
        await wire.settle()
        assert token.asked[-1] == ("gather", [1, 2])
        assert [what for what, _ in token.asked].count("gather") == 1

    asyncio.run(main())
