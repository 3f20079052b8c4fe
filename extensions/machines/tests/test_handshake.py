"""Two processes come to one session, whatever is lost, late or said again."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from extensions.machines.tests.samples import settings
from runtime.config.model import Config
from visnav_machines.handshake import Handshakes
from visnav_machines.membership import Membership
from visnav_machines.peers import Peers
from visnav_machines.session import derive

CONFIG: Config = settings(("asker", "Asker", {}), ("one", "Answerer", {}), shared=False, meet="x/y")
KEY = derive(b"secret", "run", "test")


class Nobody:
    """In the place of `Peers`."""

    def __init__(self) -> None:
        self.lost = self.joined = self.receive = lambda *_: None

    def now(self, ago: int = 0) -> int:
        return -ago


class Pair:
    """Two rosters, and a wire that remembers all that was ever said."""

    def __init__(self) -> None:
        self.ends = {
            name: Membership(CONFIG, [name], cast("Peers", Nobody())) for name in ("asker", "one")
        }
        self.greetings: dict[str, Handshakes] = {}
        self.under_way: dict[str, deque[bytes]] = {name: deque() for name in self.ends}
        self.said: list[tuple[str, bytes]] = []
        self.due: deque[partial[Any]] = deque()
        for name, roster in self.ends.items():
            roster.soon = self.soon  # type: ignore[method-assign]
            greeting = Handshakes(KEY, End(self, name), roster)  # type: ignore[arg-type]
            self.greetings[name] = roster._handshakes = greeting

    def other(self, name: str) -> str:
        return "one" if name == "asker" else "asker"

    def deliver(self, to: str) -> None:
        if self.under_way[to]:
            self.receive(to, self.under_way[to].popleft())

    def receive(self, to: str, message: bytes) -> None:
        self.ends[to]._receive(self.other(to), message, b"")
        self.do_all_due()

    def show(self, to: str, here: bool) -> None:
        self.greetings[to].on_presence(self.other(to), here)
        self.do_all_due()

    def soon(self, call: Callable[..., Any], *args: Any) -> None:
        self.due.append(partial(call, *args))

    def do_all_due(self) -> None:
        """Be the loop of both."""
        while self.due:
            self.due.popleft()()

    def settle(self) -> None:
        """Let everything arrive; who is not known greets again and again."""
        for _ in range(5):
            for name, greeting in self.greetings.items():
                if self.other(name) not in greeting._contacts:
                    self.show(name, True)
                greeting.greet_again()
            while any(self.under_way.values()):
                for name in self.ends:
                    self.deliver(name)

    def tags(self) -> list[bytes]:
        members = [g.member(self.other(n)) for n, g in self.greetings.items()]
        return [b"" if m is None else m.sealing.tag for m in members]


class End:
    """One end of the wire."""

    def __init__(self, pair: Pair, name: str) -> None:
        self.id = name
        self._pair = pair

    def send(self, other: str, message: bytes, payload: bytes) -> None:
        assert payload == b""
        self._pair.said.append((other, message))
        self._pair.under_way[other].append(message)


WHO = st.sampled_from(["asker", "one"])
OPS = st.lists(
    st.one_of(
        st.tuples(st.just("deliver"), WHO),
        st.tuples(st.just("lose"), WHO),
        st.tuples(st.just("part"), WHO),
        st.tuples(st.just("meet"), WHO),
        st.tuples(st.just("again"), st.integers(0, 30)),
    ),
    max_size=30,
)


def run(pair: Pair, ops: list[tuple[str, Any]]) -> None:
    for what, which in ops:
        match what:
            case "deliver":
                pair.deliver(which)
            case "lose":
                pair.under_way[which].clear()
            case "part" | "meet":
                pair.show(which, what == "meet")
            case "again" if pair.said:
                to, message = pair.said[which % len(pair.said)]
                pair.receive(to, message)


CROSSED: list[tuple[str, Any]] = [
    *[("meet", "asker"), ("deliver", "one"), ("part", "one"), ("meet", "asker")],
    *[("deliver", "one"), ("meet", "asker"), ("meet", "asker"), ("again", 15), ("lose", "one")],
]
"""Of two greetings that cross, each end begins a session with another one."""


ANSWERED: list[tuple[str, Any]] = [
    *[("meet", "asker"), ("again", 0), ("deliver", "asker"), ("meet", "asker"), ("again", 3)],
    ("lose", "asker"),
]
"""An answer to a greeting from before the session is still on its way when there is one."""


@pytest.mark.slow
@given(OPS)
@example(CROSSED)
@example(ANSWERED)
def test_both_end_in_one_session_that_nothing_old_can_end(ops: list[tuple[str, Any]]) -> None:
    async def main() -> None:
        pair = Pair()
        run(pair, ops)
        pair.settle()
        here, there = pair.tags()
        assert here == there != b""
        for to, message in list(pair.said):
            pair.receive(to, message)
            pair.settle()
        assert pair.tags() == [here, there]

    asyncio.run(main())


def test_who_comes_back_hears_how_often_it_was_lost() -> None:
    async def example() -> None:
        for lost, times in (((), 1), (("one",), 1), (("one", "other", "one"), 2)):
            pair = Pair()
            pair.ends["asker"].settle(lost=lost)
            for name in pair.ends:
                pair.show(name, True)
            pair.settle()
            assert await pair.ends["one"].numbers() == times
            assert await pair.ends["asker"].numbers() == 0

    asyncio.run(example())


def test_who_is_lost_before_the_loop_comes_to_who_waits_for_it_was_met() -> None:
    """Else a new process that takes its place would be one of another meeting."""

    async def example() -> None:
        pair = Pair()
        waiting = asyncio.create_task(pair.ends["one"].numbers())
        await asyncio.sleep(0)
        pair.settle()
        pair.show("one", False)
        assert await asyncio.wait_for(waiting, 10) == 0
        assert pair.ends["one"].count == 2
        assert pair.ends["one"].seats[0].absent

    asyncio.run(example())


def test_who_has_another_secret_is_not_met_and_is_named(caplog: Any) -> None:
    async def example() -> None:
        pair = Pair()
        pair.greetings["one"]._key = derive(b"another secret", "run", "test")
        for name in pair.ends:
            pair.show(name, True)
        pair.settle()
        assert pair.tags() == [b"", b""]
        assert pair.greetings["asker"].refused > 0

    asyncio.run(example())
    assert caplog.text.count("from one: expected a message of this run, found another seal") == 1


def test_of_a_flood_of_strangers_few_are_remembered() -> None:
    async def example() -> None:
        pair = Pair()
        greeting = pair.greetings["asker"]
        greeting._session.send = lambda *_: None  # type: ignore[method-assign]
        for number in range(10_000):
            greeting.on_presence(f"stranger{number}", True)
            pair.ends["asker"]._receive(f"other{number}", b"\1" * 40, b"")
        assert len(greeting._contacts) <= 256
        assert len(greeting._complained) <= 256

    asyncio.run(example())
