"""Whatever nodes do, and however messages are delayed, they do it in the order of one process."""

from __future__ import annotations

import heapq
from collections import deque
from random import Random
from typing import Any, cast

from hypothesis import given
from hypothesis import strategies as st

from events import Event
from visnav_machines.messages import NEVER, EventMessage, Key, Ordered
from visnav_machines.time_token import TimeTokenHolder

Plan = list[tuple[int, int, int]]
"""For each node: it begins at a time, comes again after a period, and says something to a node."""


class Timeline:
    """Simulated time: a heap of what is due; stands in for a loop."""

    def __init__(self) -> None:
        self.now = 0
        self.order = 0
        self.heap: list[tuple[int, int, int]] = []

    def orders(self) -> tuple[int, int]:
        return self.order, 0

    def move(self, now: int, orders: tuple[int, int]) -> None:
        self.now = max(self.now, now)
        self.order = orders[0]

    def add(self, due: int, node: int) -> None:
        heapq.heappush(self.heap, (due, self.order, node))
        self.order += 1

    def key(self) -> Key:
        return (self.heap[0][0], 2, self.heap[0][1]) if self.heap else NEVER


class Nodes:
    """Nodes in one process or several; writes down who does what when."""

    def __init__(self, plan: Plan, owners: list[int], end: int) -> None:
        self.plan = plan
        self.owners = owners
        self.end = end
        self.diary: list[tuple[int, str, int]] = []
        self.count = max(owners) + 1
        self.timelines = [Timeline() for _ in range(self.count)]
        self.net: dict[tuple[int, int], deque[tuple[Any, Event | None]]] = {}
        self.turns: list[TimeTokenHolder] = []
        for me in range(self.count):
            self.turns.append(
                TimeTokenHolder(
                    me,
                    self.count,
                    cast("Any", self.timelines[me]),
                    self.sender(me),
                    self.receiver(me),
                )
            )
        for node, (begin, _, _) in enumerate(plan):
            timeline = self.timelines[owners[node]]
            timeline.order = node << 16
            timeline.add(begin, node)
        for timeline in self.timelines:
            timeline.order = len(plan) << 16

    def sender(self, me: int) -> Any:
        def send(other: int, message: Any, event: Event | None) -> None:
            self.net.setdefault((me, other), deque()).append((message, event))

        return send

    def receiver(self, me: int) -> Any:
        def deliver(_: int, message: Ordered, __: Event | None) -> None:
            assert isinstance(message, EventMessage)
            self.hear(me, int(message.output))

        return deliver

    def fire(self, me: int) -> None:
        """Do what is due first in a process."""
        timeline = self.timelines[me]
        due, _, node = heapq.heappop(timeline.heap)
        timeline.now = max(due, timeline.now)
        if due > self.end:
            return
        self.diary.append((timeline.now, "does", node))
        _, period, hearer = self.plan[node]
        if self.owners[hearer] == me:
            self.hear(me, hearer)
        else:
            self.turns[me].post(self.owners[hearer], EventMessage(str(hearer)))
        timeline.add(due + period, node)

    def hear(self, me: int, node: int) -> None:
        """Hear something: the node does something again at once, and answers nobody."""
        timeline = self.timelines[me]
        self.diary.append((timeline.now, "hears", node))


def alone(plan: Plan, end: int) -> list[tuple[int, str, int]]:
    nodes = Nodes(plan, [0] * len(plan), end)
    timeline = nodes.timelines[0]
    while timeline.heap:
        nodes.fire(0)
    return nodes.diary


def apart(plan: Plan, owners: list[int], end: int, random: Random) -> list[tuple[int, str, int]]:
    """Run in several processes; what can happen next happens in an order that is drawn."""
    nodes = Nodes(plan, owners, end)
    everybody = list(range(nodes.count))
    for turns in nodes.turns:
        turns.gather(everybody, [str(n) for n in everybody], everybody)
    idle: set[int] = set()
    while len(idle) < nodes.count or any(nodes.net.values()):
        pairs = [pair for pair, waiting in nodes.net.items() if waiting]
        if pairs and random.random() < 0.5:
            sender, receiver = pair = random.choice(pairs)
            message, event = nodes.net[pair].popleft()
            nodes.turns[receiver].receive(sender, message, event)
            idle.clear()
            continue
        me = random.choice(everybody)
        before = sum(map(len, nodes.net.values()))
        if nodes.turns[me].may_go(nodes.timelines[me].key()):
            nodes.fire(me)
            idle.clear()
        elif sum(map(len, nodes.net.values())) == before:
            idle.add(me)
        else:
            idle.clear()
    return nodes.diary


@st.composite
def programs(draw: st.DrawFn) -> tuple[Plan, list[int]]:
    count = draw(st.integers(2, 5))
    plan = [
        (draw(st.integers(0, 5)), draw(st.integers(1, 7)), draw(st.integers(0, count - 1)))
        for _ in range(count)
    ]
    processes = draw(st.integers(2, count))
    owners = [*range(processes), *(draw(st.integers(0, processes - 1)) for _ in plan[processes:])]
    return plan, owners


@given(programs(), st.integers(0, 1 << 32))
def test_the_order_is_that_of_one_process(program: tuple[Plan, list[int]], seed: int) -> None:
    plan, owners = program
    assert apart(plan, owners, 12, Random(seed)) == alone(plan, 12)
