"""What a run says of itself while nothing goes on: whom simulated time waits for, and who spins."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from typing import ClassVar

import pytest

from runtime import Node, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.execute import execute
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
