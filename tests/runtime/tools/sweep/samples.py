"""A node that judges something made up, runs that are none, and the command as a process."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from events import Event
from runtime import Duration, Node, NodeConfig, Output, Tick, every
from runtime.tools.sweep import Job, Plan, Row, make_plan
from runtime.tools.sweep.tables import crashed
from tests.runtime.tools.samples_cli import ROOT


class Said(Event):
    """Something random."""

    number: float


class JudgeConfig(NodeConfig):
    """Settings of a judge."""

    rate: float = 10.0
    latency: Duration = Duration(0)
    method: str = "flow"
    limit: float = 100.0
    fail: bool = False
    sign: str = ""


class Judge(Node[JudgeConfig]):
    """Says something random for half a second, and judges an estimator that is not there.

    With `sign`, writes a line into that file instead, and goes on until it is told to stop.
    """

    said = Output(Said)

    @every(hz=20)
    def speak(self, tick: Tick) -> None:
        self.said.send(Said(stamp=tick.stamp, source=self.name, number=self.rng.random()))

    async def run(self) -> None:
        if self.config.sign:
            await self.offload(Path(self.config.sign).write_text, "running\n")
            await asyncio.get_running_loop().create_future()
        await self.clock.sleep(0.5)
        if self.config.fail:
            raise RuntimeError("out of order")
        error = self.config.rate + self.rng.random()
        figures = {"ate_percent": error, "lost_seconds": 0, "failed": ["one", "two"]}
        self.conclude("vo", figures, passed=error < self.config.limit)
        self.stop("judged")


BESIDE = f"from {__name__} import Judge\n\n\nclass Own(Judge):\n    pass\n"
"""Module beside a file, with a judge of one's own."""


def judge_file(
    folder: Path, settings: str = "", type_: str = f"{__name__}:Judge", run: str = ""
) -> Path:
    """Write a file with a judge."""
    path = folder / "judge.toml"
    path.write_text(
        f"[run]\nname = 'judged'\nseed = 3\nduration = '100s'\n{run}\n"
        f"[[nodes]]\nname = 'judge'\ntype = '{type_}'\n{settings}\n",
        encoding="utf-8",
    )
    return path


def plan_in(folder: Path, *vary: str, **options: Any) -> Plan:
    """Plan a sweep of a judge, with all results in the folder, too."""
    return make_plan(judge_file(folder), vary, out=folder / "out", **options)


def pretend(job: Job) -> Row:
    """Make up a finished row without running anything; the rate is the error."""
    row = crashed(job, "")
    settings = dict(job.settings)
    error = float(settings.get("judge.rate", 1.0)) + job.seed / 100
    figures = {"passed": error < 50, "ate_percent": error, "note": "made up"}
    row["exit_code"], row["passed"], row["wall_seconds"] = 0, error < 50, 0.5
    row["estimators"] = {"vo": figures, "slam": figures | {"ate_percent": error / 2}}
    return row


def figures_of(rows: Sequence[Row]) -> list[Row]:
    """Return rows without what they were made from."""
    return [{k: v for k, v in row.items() if k != "made_from"} for row in rows]  # type: ignore[misc]


def refuse(job: Job) -> Row:
    """Fail: this job should not have been run."""
    raise AssertionError(f"{job} was run")


def die(job: Job) -> Row:
    """Take the process along."""
    os._exit(3)


@contextmanager
def started(arguments: Sequence[str | Path], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start the command in a folder, in a process group of its own, as a terminal does."""
    process = subprocess.Popen(
        [sys.executable, "-m", "runtime", "sweep", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    with process:
        try:
            yield process
        finally:
            for _ in range(2):  # else its runs would live on
                process.send_signal(signal.SIGINT)
