"""Whole runs that are paused and stepped from another thread: what happens in them is the same."""

from __future__ import annotations

import logging
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import ClassVar

import msgspec
import pytest

from runtime import Node, NodeConfig
from runtime.config.model import Config, RunConfig
from runtime.config.reading import load
from runtime.run.execute import execute
from runtime.testing import spec
from runtime.units import Duration
from tests.runtime.channels.test_same_digest import FILE
from tests.runtime.samples_everything import Talker


class Restless(Node[NodeConfig]):
    """Pauses and steps the run's time at random, asked for by a thread in real time."""

    async def run(self) -> None:
        self.done = threading.Event()
        self.stepping.pause()
        thread = threading.Thread(target=self.ask, args=(random.Random(),), daemon=True)
        thread.start()

    def ask(self, chance: random.Random) -> None:
        loop, stepping = self.clock._loop, self.stepping  # type: ignore[attr-defined]
        for _ in range(40):
            act = chance.choice(
                [
                    lambda: stepping.step(chance.randrange(1, 40_000_000)),
                    stepping.step,
                    stepping.pause,
                    stepping.resume,
                ]
            )
            time.sleep(0.002 * chance.random())  # real time is what this is about
            loop.call_soon_threadsafe(act)
        loop.call_soon_threadsafe(stepping.resume)


class PausedConfig(NodeConfig):
    number: int


class Paused(Node[PausedConfig]):
    """Pauses, and sends the process a signal a little later in real time."""

    is_now: ClassVar[bool] = False

    async def run(self) -> None:
        self.stepping.pause()
        Paused.is_now = True
        threading.Timer(0.6, self.signal).start()  # six limits of the watchdog

    def signal(self) -> None:
        Paused.is_now = False
        os.kill(os.getpid(), self.config.number)


def burn() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "while True: pass"])


@pytest.mark.slow
def test_a_stepped_run_has_the_digest_of_one_that_was_never_paused(tmp_path: Path) -> None:
    file = tmp_path / "all.toml"
    file.write_text(FILE.format(samples="tests.runtime.samples_everything"), encoding="utf-8")
    config = load(file)
    stepped = msgspec.structs.replace(config, nodes=(*config.nodes, spec(Restless, "restless")))
    quiet = execute(config)
    busy = [burn() for _ in range(os.cpu_count() or 1)]
    try:
        summaries = [execute(stepped) for _ in range(3)]
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert {summary.digest for summary in summaries} == {quiet.digest}
    assert {summary.sim_seconds for summary in summaries} == {quiet.sim_seconds}


class Lines(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if Paused.is_now:  # starting and ending may take their time
            self.lines.append(record.getMessage())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_paused_run_at_once_and_a_pause_is_no_fault(number: signal.Signals) -> None:
    lines = Lines()
    run = RunConfig(duration=Duration(60), progress_limit=Duration(0.1), stall=Duration(0))
    nodes = (spec(Paused, "paused", {"number": number}), spec(Talker, "talker"))
    summary = execute(Config(run=run, nodes=nodes), handlers=[lines])
    assert (summary.reason, summary.error) == (
        {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[number],
        None,
    )
    assert (summary.sim_seconds, lines.lines) == (0.0, [])
