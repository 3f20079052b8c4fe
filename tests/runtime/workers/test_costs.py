"""What calls of workers cost: measured in their processes, and shown beside what was declared."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.judging.report.tables import Facts
from runtime import Duration, Node
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.summary import WORKER_COLUMNS, Summary, WorkerSummary
from runtime.testing import spec
from runtime.tools.cli.brief import run_tables
from runtime.tools.sweep import write_tables
from runtime.workers.costs import Costs
from tests.runtime.samples_workers import Plant
from tests.runtime.tools.sweep.samples import plan_in, pretend
from tests.runtime.workers.test_worker import worker

pytestmark = pytest.mark.timeout(60)

MS = 1_000_000


@pytest.mark.slow
async def test_waiting_takes_real_time_only_and_computing_processor_time_too() -> None:
    async with worker() as plant:
        for _ in range(3):
            await plant.call(Plant.sleep, 0.2)
        waited = plant.costs.cpu.maximum
        assert plant.costs.calls == plant.costs.wall.count() == 3
        assert plant.costs.wall.quantile(0.1) >= 200 * MS
        assert waited < 100 * MS
        await plant.call(Plant.burn, 0.2)
        assert 200 * MS <= plant.costs.cpu.maximum < plant.costs.wall.maximum + 100 * MS


@pytest.mark.slow
async def test_threads_that_go_on_after_an_answer_are_counted_with_the_next() -> None:
    async with worker() as plant:
        await plant.call(Plant.burn_beside, 0.2)
        await plant.call(Plant.join)
        costs = plant.costs.cpu
        assert costs.quantile(0.25) + costs.maximum >= 200 * MS


async def test_a_call_that_fails_is_counted_and_making_the_object_is_not() -> None:
    async with worker(processes=2) as plant:
        assert plant.costs.calls == 0
        with pytest.raises(LookupError):
            await plant.call(Plant.fail)
        assert (plant.costs.calls, plant.costs.processes) == (1, 2)


@pytest.mark.slow
async def test_memory_is_that_of_the_process_at_its_fullest() -> None:
    async with worker() as plant:
        before = plant.costs.peak
        assert 5e6 < before < 150e6
        await plant.call(Plant.fill, 200_000_000)
    assert before + 190e6 < plant.costs.peak < before + 300e6


@given(st.lists(st.tuples(st.integers(0, 10**12), st.integers(0, 10**12)), max_size=300))
def test_whatever_the_costs_the_percentiles_are_in_order(calls: list[tuple[int, int]]) -> None:
    costs = Costs()
    for wall, cpu in calls:
        costs.add(wall, cpu)
    summary = WorkerSummary.of(costs)
    assert summary.calls == len(calls)
    assert 0 <= summary.wall_p50_ms <= summary.wall_p95_ms <= summary.wall_max_ms
    assert summary.wall_max_ms == max((wall for wall, _ in calls), default=0) / MS
    assert 0 <= summary.cpu_p50_ms <= summary.cpu_p95_ms <= summary.cpu_max_ms
    assert len(summary.row()) == len(WORKER_COLUMNS)


class Gardener(Node):
    """Has a plant, which dies in the node's first life, and one that is asked at any latency."""

    lives = 0

    async def run(self) -> None:
        plant = await self.worker(Plant, latency=0.08)
        for _ in range(3):
            await plant.call(Plant.burn, 0.01)
        type(self).lives += 1
        if self.lives == 1:
            await plant.call(Plant.die, 1)
        other = await self.worker(Plant.again)
        for number in range(4):
            await other.call_for(0.01 * number, Plant.pid)


@pytest.mark.slow
def test_a_runs_summary_and_tables_say_what_each_worker_has_cost(tmp_path: Path) -> None:
    Gardener.lives = 0
    settings = RunConfig(duration=Duration(2.0), seed=3)
    config = Config(run=settings, nodes=(spec(Gardener, "g", on_error="restart"),))
    summary = execute(config, tmp_path)
    assert set(summary.workers) == {"g.Plant", "g.again"}
    plant, other = summary.workers["g.Plant"], summary.workers["g.again"]
    assert (plant.latency_ms, plant.calls, plant.processes) == (80.0, 6, 1)  # of both lives
    assert (other.latency_ms, other.calls) == (None, 4)
    assert plant.cpu_p50_ms >= 10
    assert plant.peak_rss_mb is not None
    assert plant.peak_rss_mb > 5
    written = (tmp_path / "summary.json").read_bytes()
    assert msgspec.json.decode(written, type=Summary).workers == summary.workers
    assert msgspec.json.decode(written, type=Facts).workers == summary.workers
    (table,) = (t for t in run_tables(summary) if str(t.title).startswith("calls of workers"))
    assert list(table.columns[0].cells) == ["g.Plant", "g.again"]
    assert list(table.columns[1].cells) == ["80", "varies"]


def test_in_a_sweep_costs_stand_beside_the_table_and_not_in_it(tmp_path: Path) -> None:
    """The table is equal for equal sweeps; costs are not."""
    tables = []
    for cost in (7.0, 9.0):
        plan = plan_in(tmp_path, "judge.rate=5,60")
        rows = [pretend(job) for job in plan.jobs]
        for row in rows:
            row["workers"] = {"vo.make_tracker": {"cpu_p50_ms": cost, "peak_rss_mb": None}}
        write_tables(plan, rows)
        tables.append((plan.out / "table.csv").read_bytes())
        with (plan.out / "costs.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        assert [line["judge.rate"] for line in lines] == ["5", "60"]
        assert {line["worker"] for line in lines} == {"vo.make_tracker"}
        assert {(line["cpu_p50_ms"], line["peak_rss_mb"]) for line in lines} == {(f"{cost}", "")}
    assert tables[0] == tables[1]


def test_processes_that_do_not_measure_themselves_are_measured_from_outside() -> None:
    code = "import time\nwhile time.process_time() < 0.1: pass\nprint(flush=True)\ninput()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        costs = Costs()
        costs.measure(7 * MS, [child.pid])
        assert costs.calls == 0  # it counts from there
        assert child.stdout is not None
        child.stdout.read(1)
        costs.measure(7 * MS, [child.pid])
        costs.measure(7 * MS, [child.pid])
        assert costs.calls == 2
        assert 0.05e9 < costs.cpu.maximum < 0.5e9
        assert costs.cpu.quantile(0.25) < 0.02e9
        assert costs.peak > 1e6
        child.communicate(b"\n")
    costs.measure(7 * MS, [child.pid])  # it has gone
    costs.measure(7 * MS, [])
    assert costs.calls == 3
