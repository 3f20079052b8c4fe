"""Whatever a call in a thread or a worker raises is its node's error, and obeys `on_error`."""

from __future__ import annotations

import logging
import re
from typing import Any

import pytest

from runtime import Node, NodeConfig
from runtime.run import supervisor
from runtime.testing import spec
from tests.runtime.samples_runs import supervise
from tests.runtime.samples_workers import ODD, Plant, raise_odd

WAYS = list(ODD)
DOORS = ["offload", "offload_for", "worker", "call_untimed"]
SLOW = {"worker", "call_untimed"}
QUICKER = ["StopIteration", "asyncio's CancelledError", "SystemExit", "unpicklable", "unloadable"]
"""For those, of which every life costs a start of Python."""


class CallerConfig(NodeConfig):
    """How it calls."""

    door: str
    ways: tuple[str, ...]


class Caller(Node[CallerConfig]):
    """Calls what raises one error in each of its lives, and stops the run in its last."""

    plant: Any

    async def on_startup(self) -> None:
        if self.config.door in SLOW:
            self.plant = await self.worker(Plant, latency=0.01)

    async def run(self) -> None:
        if self.restarts == len(self.config.ways):
            self.stop("all are raised")
            return
        way = self.config.ways[self.restarts]
        if self.config.door == "offload":
            await self.offload(raise_odd, way)
        elif self.config.door == "offload_for":
            await self.offload_for(0.01, raise_odd, way)
        elif self.config.door == "worker":
            await self.plant.call(Plant.fail_as, way)
        else:
            await self.plant.call_untimed(Plant.fail_as, way)


@pytest.mark.parametrize(
    ("door", "clock"),
    [
        pytest.param(door, clock, marks=[pytest.mark.slow] * (door in SLOW))
        for door in DOORS
        for clock in ("lockstep", "real")
        if (door, clock) != ("call_untimed", "lockstep")  # for which time does not wait
    ],
)
def test_each_is_reported_as_its_nodes_and_the_node_restarts(
    door: str, clock: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(supervisor, "FIRST_BACKOFF", 1e-4)
    monkeypatch.setattr(supervisor, "LONGEST_BACKOFF", 1e-3)
    caplog.set_level(logging.ERROR)
    ways = QUICKER if door in SLOW else WAYS
    nodes = [spec(Caller, "caller", {"door": door, "ways": tuple(ways)}, on_error="restart")]
    outcome = supervise(nodes, clock=clock, duration=60)
    assert (outcome.error, outcome.reason) == (None, "all are raised")
    errors = [record for record in caplog.records if record.levelno == logging.ERROR]
    told = [record.getMessage() for record in errors]
    assert len(told) == len(ways)
    for way, text in zip(ways, told, strict=True):
        said = ODD[way][1]
        if door in SLOW and way in {"unpicklable", "unloadable"}:
            said = f"RuntimeError: {said}"
        assert text.startswith(f"caller: {said}"), text
        line = (
            r"\(runtime/samples_workers.py:\d+ in raise_odd|run/test_faults_beside.py:\d+ in run\)"
        )
        assert re.search(line, text), text
    for record in errors:
        assert record.exc_info or record.exc_text, "the traceback is in the log"


@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize(
    ("door", "way"),
    [
        ("offload", "StopIteration"),
        ("offload_for", "a thread's CancelledError"),
        pytest.param("worker", "StopIteration", marks=pytest.mark.slow),
        pytest.param("worker", "SystemExit", marks=pytest.mark.slow),
    ],
)
def test_it_ends_the_run_or_the_node_as_the_file_says(clock: Any, door: str, way: str) -> None:
    def end(rule: Any) -> Any:
        settings = {"door": door, "ways": (way,)}
        return supervise([spec(Caller, "caller", settings, on_error=rule)], clock=clock)

    stopped = end("stop")
    assert str(stopped.error).startswith(f"caller: {ODD[way][1]}")
    assert stopped.reason == "caller failed"
    dropped = end("drop")
    assert (dropped.error, dropped.reason) == (None, "duration")


@pytest.mark.slow
def test_an_error_in_making_a_workers_object_is_the_nodes_too() -> None:
    class Hasty(Node):
        async def on_startup(self) -> None:
            await self.worker(raise_odd, "StopIteration")

    outcome = supervise([spec(Hasty, "hasty")])
    assert str(outcome.error) == "hasty: StopIteration: seeds"
