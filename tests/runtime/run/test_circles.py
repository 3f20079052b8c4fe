"""Nodes whose handlers answer one another: told by one error, and by a check before any run."""

from __future__ import annotations

import logging

import pytest

from events import Event
from runtime import Node, Output, on
from runtime.errors import NodeError
from runtime.run import graph
from runtime.testing import run_nodes, spec
from tests.runtime.samples_runs import supervise


class Ping(Event):
    pass


class Pong(Event):
    pass


class Asks(Node):
    pings = Output(Ping)

    @on(Pong)
    def ask(self, _: Pong) -> None:
        self.pings.send(Ping(stamp=0, source=self.name))


class Begins(Asks):
    async def run(self) -> None:
        self.pings.send(Ping(stamp=0, source=self.name))


class Answers(Node):
    pongs = Output(Pong)

    @on(Ping)
    def answer(self, _: Ping) -> None:
        self.pongs.send(Pong(stamp=0, source=self.name))


class AnswersOnce(Answers):
    answered = False

    @on(Ping)
    def answer(self, _: Ping) -> None:
        if not self.answered:
            self.answered = True
            self.pongs.send(Pong(stamp=0, source=self.name))


class Recurses(Node):
    @on(Ping)
    def recurse(self, ping: Ping) -> None:
        self.recurse(ping)


CIRCLE = "a.pings → b.answer, b.pongs → a.ask"


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_two_that_answer_each_other_end_the_run_with_one_error(
    clock: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        outcome = supervise([spec(Begins, "a"), spec(Answers, "b")], clock=clock)
    assert str(outcome.error) == (
        "b: expected handlers that come to an end, found some that answer one another: " + CIRCLE
    )
    assert len(caplog.records) == 1
    assert outcome.supervisor.state.run_end is not None
    assert outcome.supervisor.state.run_end.by == "b"


def test_a_node_that_calls_itself_for_ever_is_named_alone() -> None:
    with pytest.raises(NodeError, match=r"^c: RecursionError: "):
        run_nodes([spec(Begins, "a"), spec(Recurses, "c")])


@pytest.mark.parametrize(
    ("answers", "expected"), [(Answers, [CIRCLE]), (AnswersOnce, []), (Recurses, [])]
)
def test_a_check_sees_handlers_that_always_answer_one_another(
    answers: type[Node], expected: list[str]
) -> None:
    assert graph.circles([("a", Asks), ("b", answers)]) == expected
