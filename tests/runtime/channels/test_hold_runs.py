"""Whole runs with a system outside the process: what the summary and the command line say of it."""

from __future__ import annotations

import asyncio
import concurrent.futures
import queue
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest

from runtime import Duration, Input, Node, NodeConfig, Output
from runtime.channels.hold import Hold, HoldConfig, Owed
from runtime.config.model import Config, OnError, RunConfig
from runtime.errors import VisnavError
from runtime.run.execute import execute
from runtime.summary import Summary
from runtime.testing import spec
from runtime.tools.cli.brief import run_tables
from runtime.units import Latency
from tests.runtime.samples import Ping, Pong, Speaker


class OutsideConfig(NodeConfig):
    """What the outside system of these tests does."""

    latency: Latency = Latency(0.03)
    hold: HoldConfig = HoldConfig()
    silent: tuple[int, ...] = ()
    dies_at: int = -1
    pause: float = 0.0


class Outside(Node[OutsideConfig]):
    """Asks a thread for an answer to each ping; it takes real time, and may be silent or die."""

    pings = Input(Ping)
    pongs = Output(Pong)

    async def on_startup(self) -> None:
        self.frames: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self.slam: Hold[int] = self.hold("slam", self.config.hold, self.config.latency)
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        """Be the outside system."""
        number = 0
        while (stamp := self.frames.get()) is not None:
            if number == self.config.dies_at and not self.restarts:
                self.slam.gone("ended with exit code 3")
                return
            threading.Event().wait(self.config.pause)
            self.slam.received()
            if number not in self.config.silent:
                self.slam.answer(stamp, number)
            number += 1

    async def run(self) -> None:
        async for ping in self.pings:
            owed = self.slam.owe(ping.stamp)
            self.start(self.deliver(owed))
            self.slam.sent("pings", ping.stamp.to_bytes(8, "little"))
            self.frames.put(ping.stamp)

    async def deliver(self, owed: Owed[int]) -> None:
        number = await owed
        if number is not None:
            self.pongs.send(Pong(stamp=owed.stamp, source=f"{self.name}/{number}"))

    async def on_shutdown(self) -> None:
        self.frames.put(None)


def run(out: Path, on_error: OnError = "stop", **config: Any) -> Summary:
    outside = spec(Outside, "outside", config, on_error)
    settings = RunConfig(duration=Duration(1.0), seed=3)
    return execute(Config(run=settings, nodes=(spec(Speaker, "speaker"), outside)), out)


@pytest.mark.slow
def test_a_run_has_the_same_digest_whatever_its_answers_take(tmp_path: Path) -> None:
    quick = run(tmp_path / "quick")
    slow = run(tmp_path / "slow", pause=0.02)
    assert quick.digest == slow.digest
    assert quick.not_deterministic == []
    summary, other = quick.outside["slam"], slow.outside["slam"]
    assert (summary.sent, summary.received, summary.answered, summary.lost, summary.open) == (
        10,
        10,
        10,
        0,
        0,
    )
    assert summary.latency_ms == 30.0
    assert summary.reproducible
    assert summary.inputs == other.inputs
    assert other.wall_p50_ms is not None
    assert other.wall_p50_ms >= 20.0


@pytest.mark.slow
def test_what_became_of_each_frame_stands_in_a_file_that_can_be_replayed(tmp_path: Path) -> None:
    run(tmp_path / "first", pause=0.01)
    file = tmp_path / "first" / "answers" / "slam.csv"
    rows = file.read_text().splitlines()
    assert rows[0] == "stamp_ns,outcome,latency_ms"
    assert len(rows) == 11
    stamp, outcome, latency = rows[1].split(",")
    assert (stamp, outcome) == ("0", "answered")
    assert float(latency) >= 10.0
    again = run(tmp_path / "again", hold={"latencies": str(file), "latency_factor": 1.5})
    twice = run(
        tmp_path / "twice", hold={"latencies": str(file), "latency_factor": 1.5}, pause=0.01
    )
    assert again.digest == twice.digest
    assert again.outside["slam"].latency_ms is None


def test_a_missing_answer_ends_the_run_by_name(tmp_path: Path) -> None:
    with pytest.raises(VisnavError, match=r"outside: .*the frame of 0\.400000 s within 0\.2 s"):
        run(tmp_path, silent=(4,), hold={"max_wait": "200ms"})
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes(), type=Summary)
    assert summary.outside["slam"].answered == 4


@pytest.mark.parametrize(("allowed", "passed"), [(0, False), (1, None)])
def test_a_lost_frame_is_in_the_verdict(tmp_path: Path, allowed: int, passed: bool | None) -> None:
    hold = {"max_wait": "200ms", "on_missing": "lost", "lost_allowed": allowed}
    summary = run(tmp_path, silent=(4,), hold=hold)
    assert (summary.outside["slam"].answered, summary.outside["slam"].lost) == (9, 1)
    assert summary.not_deterministic == ["slam"]
    if passed is None:
        assert summary.verdict is None
    else:
        assert summary.verdict is not None
        assert summary.verdict.passed is passed
        (failed,) = summary.verdict.estimators["slam (answers)"]["failed"]
        assert failed == "lost_frames: expected at most 0, found 1"
    titles = [str(table.title) for table in run_tables(summary)]
    assert "systems outside the process: frames" in titles


def test_a_system_that_ends_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(VisnavError, match="outside: slam: ended with exit code 3"):
        run(tmp_path, dies_at=5, hold={"max_wait": "1h"})


def test_a_restarted_one_goes_on_with_the_counts_of_the_first(tmp_path: Path) -> None:
    summary = run(tmp_path, "restart", dies_at=2)
    counts = summary.outside["slam"]
    assert counts.answered >= 2
    assert counts.sent >= counts.answered + 1


def test_going_on_without_answers_is_said(tmp_path: Path) -> None:
    hold = {"max_wait": "200ms", "on_missing": "continue"}
    summary = run(tmp_path, silent=(4, 5, 6, 7, 8, 9), hold=hold)
    counts = summary.outside["slam"]
    assert (counts.answered, counts.open, counts.reproducible) == (4, 6, False)
    assert summary.not_deterministic == ["slam"]


class Absent(Node):
    """Waits for ever, at one instant, for a system that does not come; then something fails."""

    async def on_startup(self) -> None:
        self.came: concurrent.futures.Future[None] = concurrent.futures.Future()

    async def run(self) -> None:
        self.start(self.fail())
        await self.clock.beside(self.came)

    async def fail(self) -> None:
        raise ValueError("no such program")


class Careful(Node):
    """Has something to write at the end."""

    async def on_shutdown(self) -> None:
        assert self.out is not None
        total = await self.offload(sum, (1, 2))
        await asyncio.to_thread((self.out / f"results_{total}.csv").touch)


def test_nobody_waits_at_the_end_for_what_does_not_come(tmp_path: Path) -> None:
    settings = RunConfig(duration=Duration(1.0), shutdown_limit=Duration(20.0))
    nodes = (spec(Absent, "absent"), spec(Careful, "careful"))
    with pytest.raises(VisnavError, match="absent: ValueError: no such program"):
        execute(Config(run=settings, nodes=nodes), tmp_path)
    assert (tmp_path / "results_3.csv").exists()
