"""What becomes of a run in which a node's worker dies or hangs."""

from __future__ import annotations

import logging
import os
import signal
from typing import ClassVar

import pytest

from runtime import Node
from runtime.errors import WorkerDiedError, WorkerTimeoutError
from runtime.testing import spec
from tests.runtime.samples_runs import supervise
from tests.runtime.samples_workers import Plant
from tests.runtime.workers.test_worker import alive

pytestmark = pytest.mark.timeout(120)


class Gardener(Node):
    """Has a plant in a process of its own, which meets its fate in its first life."""

    fate: ClassVar[str] = "die"
    pids: ClassVar[list[int]] = []
    answers: ClassVar[list[int]] = []

    async def on_startup(self) -> None:
        self.plant = await self.worker(Plant, timeout=6.0 if self.fate == "hang" else 60.0)
        self.pids.append(await self.plant.call(Plant.pid))

    async def run(self) -> None:
        await self.clock.sleep(0.1)
        if len(self.pids) == 1:
            if self.fate == "die":
                await self.plant.call(Plant.die, 7)
            elif self.fate == "hang":
                await self.plant.call(Plant.sleep, 1000.0)
            else:
                os.kill(self.pids[0], signal.SIGKILL)
                await self.clock.sleep(1000)
        self.answers.append(await self.plant.call(Plant.echo, len(self.pids)))
        if len(self.pids) == 2:
            self.stop("answered")


@pytest.fixture(autouse=True)
def _new_garden() -> None:
    Gardener.pids.clear()
    Gardener.answers.clear()


FATES = [
    ("die", "lockstep", WorkerDiedError, "worker g.Plant: ended with exit code 7; .*\ngoodbye"),
    ("die", "real", WorkerDiedError, "worker g.Plant: ended with exit code 7; .*\ngoodbye"),
    pytest.param(
        *("hang", "lockstep", WorkerTimeoutError, "worker g.Plant: no answer in 6 s"),
        marks=pytest.mark.slow,
    ),
    ("idle", "real", WorkerDiedError, "worker g.Plant: killed by signal 9 .*; it said nothing"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("fate", "clock", "error", "text"), FATES)
def test_a_worker_that_ends_is_its_nodes_fault(
    fate: str, clock: str, error: type[Exception], text: str
) -> None:
    Gardener.fate = fate
    outcome = supervise([spec(Gardener, "g")], clock=clock, duration=10)
    assert outcome.reason == "g failed"
    assert outcome.error is not None
    assert isinstance(outcome.error.__cause__, error)
    with pytest.raises(type(outcome.error), match=f"g: {text}"):
        raise outcome.error
    assert not alive(Gardener.pids[0])


@pytest.mark.slow
@pytest.mark.parametrize(("fate", "clock"), [("die", "lockstep"), ("idle", "real")])
def test_a_restarted_node_has_a_new_worker(fate: str, clock: str) -> None:
    Gardener.fate = fate
    outcome = supervise([spec(Gardener, "g", on_error="restart")], clock=clock, duration=30)
    assert outcome.error is None
    assert Gardener.answers == [2]
    assert len(set(Gardener.pids)) == 2
    assert not any(alive(pid) for pid in Gardener.pids)


@pytest.mark.parametrize(
    ("trouble", "text"),
    [
        ("value", "g: ValueError: no such plant"),
        ("exit", "g: SystemExit: 3"),
        ("end", "g: worker g.Plant: ended with exit code 3"),
    ],
)
def test_a_worker_that_cannot_be_made_ends_the_start(trouble: str, text: str) -> None:
    class Hasty(Node):
        async def on_startup(self) -> None:
            await self.worker(Plant, trouble)

    outcome = supervise([spec(Hasty, "g")])
    assert str(outcome.error).startswith(text)


@pytest.mark.slow
def test_the_end_of_a_run_ends_its_workers() -> None:
    Gardener.fate = "none"
    Gardener.pids.append(0)
    outcome = supervise([spec(Gardener, "g")], duration=0.5)
    assert outcome.error is None
    assert not alive(Gardener.pids[1])


def test_what_a_worker_prints_stands_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    class Hears(Node):
        async def run(self) -> None:
            plant = await self.worker(Plant)
            await plant.call(Plant.say, "a leaf\nanother")
            self.stop("said")

    caplog.set_level(logging.INFO)
    supervise([spec(Hears, "g")])
    told = [(r.name, r.levelname, r.getMessage()) for r in caplog.records if "Plant" in r.message]
    assert told == [
        ("visnav.g", "INFO", "Plant: a leaf"),
        ("visnav.g", "INFO", "Plant: another"),
    ]
