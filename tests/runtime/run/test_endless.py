"""Nodes that announce or lack things without end: a start has a limit, in number and in time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any

import pytest

from events import Announcement
from runtime import Node
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeTimeoutError
from runtime.run import node_runner
from runtime.run.node_runner import MOST_VALUES
from runtime.testing import spec
from runtime.tools.preflight import of_nodes
from tests.runtime.samples import Offer
from tests.runtime.samples_runs import supervise


class Announces(Node):
    def announce(self) -> Iterator[Announcement]:
        for number in itertools.count():
            yield Offer(stamp=0, source=f"{self.name}/{number}")


class Lacks(Node):
    def check(self) -> Iterator[str]:
        for number in itertools.count():
            yield f"need {number}"


class AnnouncesSlowly(Announces):
    def announce(self) -> Iterator[Announcement]:
        for announcement in super().announce():
            time.sleep(0.01)  # real: a start is limited in real time
            yield announcement


class LacksSlowly(Node):
    def check(self) -> Iterator[str]:
        while True:
            time.sleep(0.01)  # real: as above
            yield "more"


@pytest.fixture(autouse=True)
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_runner, "MOST_VALUES", 300)


@pytest.mark.parametrize(("node", "phase"), [(Announces, "announce"), (Lacks, "check")])
def test_an_endless_list_is_its_nodes_error(node: type[Node], phase: str) -> None:
    says = f"endless: {phase}(): expected an end after at most 300 values, found more"
    outcome = supervise([spec(node, "endless")])
    assert str(outcome.error) == says
    findings = of_nodes(Config(run=RunConfig(), nodes=(spec(node, "endless"),)))
    assert findings.errors == [says]


@pytest.mark.parametrize(("node", "phase"), [(AnnouncesSlowly, "announce"), (LacksSlowly, "check")])
def test_a_slow_one_has_the_limit_of_the_start(node: type[Node], phase: str) -> None:
    outcome = supervise([spec(node, "slow")], startup_limit=0.05)
    assert isinstance(outcome.error, NodeTimeoutError)
    assert f"slow: expected {phase} to end within 0.05 s (run.startup_limit)" in str(outcome.error)


def test_what_ends_is_taken_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Any] = []

    class Few(Announces):
        def announce(self) -> Iterator[Announcement]:
            return itertools.islice(super().announce(), 300)

        def on_announcement(self, announcement: Announcement) -> None:
            heard.append(announcement)

    assert supervise([spec(Few, "few")]).error is None
    assert len(heard) == 300 < MOST_VALUES
