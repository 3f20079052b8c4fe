"""What a run says of itself while nothing goes on: whom simulated time waits for, and who spins."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import signal
import time
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import pytest

from events import Announcement
from runtime import Node, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError, NodeTimeoutError
from runtime.run.execute import execute
from runtime.testing import spec
from runtime.units import Duration


class Told(logging.Handler):
    """Waits for a message."""

    wanted: ClassVar[str]
    lines: ClassVar[list[str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())

    @classmethod
    def awaited(cls) -> bool:
        """Whether it was not there yet, and there is hope."""
        return not any(re.search(cls.wanted, line) for line in cls.lines) and len(cls.lines) < 5


class Busy(Node):
    """Has something due now and then, as other nodes have while one stands still."""

    @every(hz=10)
    def tick(self, _: Tick) -> None:
        pass


class Waiting(Node):
    async def run(self) -> None:
        await self.offload(self.wait_to_be_told)

    def wait_to_be_told(self) -> None:
        while Told.awaited():
            time.sleep(0.01)


class Spinning(Node):
    async def run(self) -> None:
        while Told.awaited():  # noqa: ASYNC110  # that is the fault
            await asyncio.sleep(0)


@pytest.mark.parametrize(
    ("node", "wanted"),
    [
        (Waiting, r"the run has waited for waiting: slow work, at "),
        (Spinning, r"no time has passed .* again and again: spinning, at "),
    ],
)
def test_a_run_that_stands_still_names_the_node_and_the_line(node: type[Node], wanted: str) -> None:
    Told.lines.clear()
    Told.wanted = wanted + r"watchdogs/test_progress\.py:\d+ in run"
    run = RunConfig(duration=Duration(0.1), progress_limit=Duration(0.2), stall=Duration(0))
    nodes = (spec(Busy, "busy"), spec(node, node.__name__.lower()))
    summary = execute(Config(run=run, nodes=nodes), handlers=[Told(logging.WARNING)])
    assert summary.reason == "duration"
    assert any(re.search(Told.wanted, line) for line in Told.lines), Told.lines


class Speaking(Node):
    async def on_startup(self) -> None:
        self.doing = "drawing"
        await self.offload(self.wait_to_be_told)
        self.doing = ""

    def wait_to_be_told(self) -> None:
        while Told.awaited():
            time.sleep(0.01)


def test_a_node_says_in_its_own_words_what_the_start_waits_for() -> None:
    Told.lines.clear()
    Told.wanted = "the run has waited for speaking: drawing$"
    run = RunConfig(duration=Duration(0.1), progress_limit=Duration(0.2), stall=Duration(0))
    execute(Config(run=run, nodes=(spec(Speaking, "speaking"),)), handlers=[Told(logging.WARNING)])
    assert any(re.search(Told.wanted, line) for line in Told.lines), Told.lines


class Starting(Node):
    async def on_startup(self) -> None:
        await self.offload(self.wait_to_be_told)

    def wait_to_be_told(self) -> None:
        end = time.monotonic() + 1.0
        while Told.awaited() and time.monotonic() < end:  # five limits: enough to be told of it
            time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("starved", [False, True])
def test_a_start_is_reported_only_if_it_had_a_processor(
    starved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = time.monotonic()
    known = {"look": lambda _: time.monotonic() - begin} if starved else {"look": lambda _: 0.0}
    monkeypatch.setattr("runtime.run.watchdogs.Starvation", type("Starvation", (), known))
    Told.lines.clear()
    Told.wanted = "the run has waited for starting: on_startup"
    run = RunConfig(duration=Duration(0.1), progress_limit=Duration(0.2), stall=Duration(0))
    execute(Config(run=run, nodes=(spec(Starting, "starting"),)), handlers=[Told(logging.WARNING)])
    assert any(Told.wanted in line for line in Told.lines) is not starved, Told.lines


class Endless(Node):
    """Never comes to the end of what it announces; the user may press Ctrl-C meanwhile."""

    interrupted: ClassVar[bool]

    def announce(self) -> Iterable[Announcement]:
        if self.interrupted:
            os.kill(os.getpid(), signal.SIGINT)
        while True:
            time.sleep(0.01)  # that is the fault


@pytest.mark.slow
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_node_that_blocks_the_start_up_is_named_and_a_first_ctrl_c_is_heard(
    interrupted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Endless, "interrupted", interrupted, raising=False)
    limit = Duration(60 if interrupted else 0.2)
    run = RunConfig(startup_limit=limit, progress_limit=Duration(0.2))
    begin = time.monotonic()
    with pytest.raises(NodeTimeoutError, match=r"^endless: expected it to give back the loop"):
        execute(Config(run=run, nodes=(spec(Endless, "endless"),)), tmp_path)
    assert time.monotonic() - begin < 20  # as soon as the watchdog, a thread, gets to look
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended_by"] == ("user" if interrupted else "endless")


class Cancels(Node):
    """Cancels all tasks of the loop, whosesoever they are."""

    async def run(self) -> None:
        await self.clock.sleep(0.2)
        for task in asyncio.all_tasks():
            task.cancel()


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_node_that_cancels_all_tasks_is_named(clock: str, tmp_path: Path) -> None:
    run = RunConfig(clock=clock, duration=Duration(1.0))  # type: ignore[arg-type]
    nodes = (spec(Busy, "busy"), spec(Cancels, "cancels"), spec(Busy, "busy2"))
    with pytest.raises(NodeError, match=r"^cancels: expected it to cancel no tasks but its own"):
        execute(Config(run=run, nodes=nodes), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["ended_by"], summary["error"][:8]) == ("cancels", "cancels:")
