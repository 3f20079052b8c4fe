"""Real runs in real processes: equal sweeps, failures, Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from runtime.tools.flights import stored
from runtime.tools.sweep import Children, make_plan, sweep, write_tables
from runtime.tools.sweep.process import kill_tree, last_error, read_results
from tests.runtime.tools.flights.samples import flight_file
from tests.runtime.tools.samples_cli import summary
from tests.runtime.tools.sweep.samples import BESIDE, judge_file, plan_in, started

pytestmark = pytest.mark.timeout(240)


@pytest.mark.slow
def test_equal_sweeps_have_equal_tables_also_with_nodes_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "own_judge.py").write_text(BESIDE, encoding="utf-8")
    config = judge_file(tmp_path, "limit = 6.5", type_="own_judge:Own")
    tables = []
    for name, jobs in [("first", 2), ("second", 1)]:
        plan = make_plan(config, ["judge.rate=5,7"], out=tmp_path / name)
        with ThreadPoolExecutor(jobs) as pool:
            rows = sweep(plan, pool)
        write_tables(plan, rows)
        tables.append([(plan.out / f"{t}.csv").read_bytes() for t in ("table", "summary")])
        assert [(row["exit_code"], row["error"]) for row in rows] == [(0, ""), (1, "")]
        assert [row["passed"] for row in rows] == [True, False]
        assert all(len(row["digest"] or "") >= 16 for row in rows)
        assert rows[0]["estimators"]["vo"]["failed"] == ["one", "two"]
        assert str(tmp_path).encode() not in tables[-1][0]
    assert tables[0] == tables[1]


@pytest.mark.slow
def test_a_run_that_fails_is_a_row_and_the_sweep_goes_on(tmp_path: Path) -> None:
    config = judge_file(tmp_path)
    options = ["--vary", "judge.fail=true,false", "--jobs", "1", "--out", "out"]
    with started([config, *options], tmp_path) as process:
        out, err = process.communicate(timeout=100)
    assert process.returncode == 2
    lines = err.splitlines()
    error = re.escape("judge: RuntimeError: out of order (sweep/samples.py:") + r"\d+ in run\)"
    assert re.fullmatch(f"1/2 judge.fail=true seed=3: crashed: {error}", lines[0])
    assert lines[1].startswith("2/2 judge.fail=false seed=3: ")
    assert lines[1].endswith(" s, 1 crashed, 0 running, 0:00:00 left")
    assert lines[2:] == ["error: 1 of 2 runs crashed"]
    assert "vo" in out
    assert f"2 runs   results in {tmp_path / 'out'}" in out
    table = (tmp_path / "out" / "table.csv").read_text(encoding="utf-8").splitlines()
    assert re.search(f"true,3,2,{error},,0.5,", table[1])
    assert "false,3,0,,true,0.5," in table[2]
    assert (tmp_path / "out" / "plots" / "judge.fail.png").stat().st_size > 5000


@pytest.mark.slow
def test_runs_with_one_flight_fly_once_and_have_the_same_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    config, tables = flight_file(tmp_path), []
    for fly in (True, False):
        vary = ["guesser.latency=0ms,30ms", "craft.rate=20,50"]
        plan = make_plan(config, vary, out=tmp_path / f"{fly}", fly=fly)
        with ThreadPoolExecutor(2) as pool:
            rows = sweep(plan, pool)
        write_tables(plan, rows)
        assert [row["error"] for row in rows] == [""] * 4
        tables.append([(plan.out / f"{t}.csv").read_bytes() for t in ("table", "summary")])
        assert len(stored()) == (0 if fly else 2)
    assert tables[0] == tables[1]


@pytest.mark.slow
def test_a_run_that_hangs_is_ended_with_its_workers_and_is_a_row(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    config = judge_file(tmp_path, run="clock = 'real'")
    plan = make_plan(config, [f"judge.sign={sign}"], out=tmp_path / "out", limit=8.0)
    children = Children()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(children.run, plan.jobs[0])
        while not sign.exists() and not future.done():
            time.sleep(0.05)  # it is another process that writes it
        processes, memory = children.usage()
        assert processes >= 1
        assert 0.01 < memory < 2
        row = future.result()
    assert (row["error"], row["exit_code"]) == ("timed out after 8 s", -signal.SIGKILL)
    assert children.usage() == (0, 0.0)


@pytest.mark.slow
def test_an_edit_during_a_run_is_noted_with_the_run(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    (tmp_path / "judge_in_flight.py").write_text(BESIDE, encoding="utf-8")
    config = judge_file(tmp_path, type_="judge_in_flight:Own", run="clock = 'real'")
    plan = make_plan(config, [f"judge.sign={sign}"], out=tmp_path / "out")
    children = Children()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(children.run, plan.jobs[0])
        while not sign.exists() and not future.done():
            time.sleep(0.05)  # it is another process that writes it
        with (tmp_path / "judge_in_flight.py").open("a") as file:
            file.write("# another\n")
        children.interrupt()
        row = future.result()
    assert row["edited"] == ["judge_in_flight.py changed"]
    assert "judge_in_flight.py" in row["parts"]


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_ends_runs_in_order(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    os.mkfifo(sign)
    config = judge_file(tmp_path, run="clock = 'real'")
    vary = f"judge.sign='',{sign},never"
    options = ["--vary", vary, "--jobs", "1", "--out", "out"]
    with started([config, *options], tmp_path) as process:
        assert sign.read_text() == "running\n"  # waits for the second run
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=100)
    assert process.returncode == 130
    assert err.splitlines()[-2:] == [
        "ending the runs that are under way; Ctrl-C ends them at once",
        f"interrupted; the same command runs what is missing in {tmp_path / 'out'}",
    ]
    plan = make_plan(config, [vary], out=tmp_path / "out")
    assert summary(Path(plan.jobs[1].out))["reason"] == "Ctrl-C"
    assert not Path(plan.jobs[2].out).exists()
    rows = [json.loads(line) for line in (plan.out / "rows.jsonl").read_text().splitlines()]
    assert [(row["id"], row["exit_code"]) for row in rows] == [(plan.jobs[0].id, 0)]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_ends_runs_at_once(tmp_path: Path, number: signal.Signals) -> None:
    config = judge_file(tmp_path, type_="tests.runtime.samples:SlowEnd", run="shutdown_limit = 100")
    with started([config, "--out", "out"], tmp_path) as process:
        assert process.stderr is not None
        (plan,) = make_plan(config, out=tmp_path / "out").jobs
        output = Path(plan.out) / "output.txt"
        while not (output.exists() and "running" in output.read_text()):
            assert process.poll() is None
            time.sleep(0.02)  # another process is starting; nothing here can be awaited
        process.send_signal(number)
        assert process.stderr.readline().startswith("ending the runs")
        process.send_signal(number)
        process.communicate(timeout=60)
    assert process.returncode == 130
    assert (tmp_path / "out" / "rows.jsonl").read_text() == ""


def gone(number: int) -> bool:
    """Tell whether a process has ended, within a minute; it is the kernel that one waits for."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.01)
    return False


ELSEWHERE = "subprocess.Popen(['sleep', '1000'], start_new_session=True).pid"
"""What a run may start, and a signal to its group does not reach."""


def test_a_run_is_killed_with_all_that_it_has_started() -> None:
    code = f"import os, subprocess\nprint({ELSEWHERE}, flush=True)\nos.read(0, 1)"
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as run:
        assert run.stdout is not None
        started_by_it = int(run.stdout.readline())
        kill_tree(run.pid)
        assert run.wait() == -signal.SIGKILL
    assert gone(started_by_it)


@pytest.mark.slow
def test_a_sweep_that_is_killed_leaves_nothing_running(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    os.mkfifo(sign)
    (tmp_path / "own.py").write_text(
        "import os, subprocess\nfrom pathlib import Path\nfrom runtime import Node\n\n\n"
        f"class Own(Node):\n    async def run(self):\n        mine = {ELSEWHERE}\n"
        f"        Path({str(sign)!r}).write_text(f'{{os.getpid()}} {{mine}}')\n"
        "        await self.clock.sleep(1e6)\n",
        encoding="utf-8",
    )
    config = judge_file(tmp_path, type_="own:Own", run="clock = 'real'")
    with started([config, "--out", "out"], tmp_path) as process:
        numbers = [int(number) for number in sign.read_text().split()]
        process.kill()
        process.wait()
        assert all(gone(number) for number in numbers)


@pytest.mark.slow
def test_a_run_that_a_signal_ends_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "own_end.py"
    path.write_text(
        "import os, signal\nfrom runtime import Node\n\n\nclass Own(Node):\n"
        "    async def run(self):\n        os.kill(os.getpid(), signal.SIGKILL)\n",
        encoding="utf-8",
    )
    config = judge_file(tmp_path, type_="own_end:Own")
    with ThreadPoolExecutor(1) as pool:
        (row,) = sweep(make_plan(config, out=tmp_path / "out"), pool)
        assert (row["exit_code"], row["error"]) == (-9, "ended by SIGKILL")
        path.write_text(path.read_text().replace("SIGKILL", "SIGINT"), encoding="utf-8")
        (row,) = sweep(make_plan(config, out=tmp_path / "out"), pool)
    assert (row["exit_code"], row["error"]) == (0, "interrupted by Ctrl-C")


def test_the_error_of_a_run_is_its_last_error_or_its_last_line() -> None:
    assert last_error("error: a\n\nerror: b: c\nwarning: d\n") == "b: c"
    assert last_error("Traceback\n  File\nValueError: x\n\n") == "ValueError: x"
    assert last_error("\n") == ""


VERDICT = {"passed": False, "estimators": {"vo": {"passed": False}}}
FIGURES = {"estimators": {"vo": {"passed": None, "ate_percent": 0.5}}}
NOT_JUDGED = {"passed": None} | FIGURES
SUMMARY = {"reason": "done", "sim_seconds": 1.5, "wall_seconds": 0.1, "digest": "abc"}


@pytest.mark.parametrize(
    ("code", "results", "expected"),
    [
        (0, SUMMARY, {"error": "", "passed": None, "digest": "abc", "sim_seconds": 1.5}),
        (0, SUMMARY | {"not_deterministic": ["slam"]}, {"error": "", "digest": None}),
        (0, {}, {"error": "summary.json: Object missing required field `reason`"}),
        (0, None, {"error": "expected a summary.json, found: No such file or directory"}),
        (1, SUMMARY | {"verdict": VERDICT}, {"error": "", "passed": False}),
        (0, SUMMARY | {"verdict": NOT_JUDGED}, {"error": "", "passed": None} | FIGURES),
        (1, SUMMARY, {"error": "no runs/ID/file at 0x…", "passed": None}),
        (2, SUMMARY | {"verdict": VERDICT}, {"passed": None, "estimators": {}, "exit_code": 2}),
        (0, SUMMARY | {"reason": "SIGTERM"}, {"error": "interrupted by SIGTERM"}),
        (-11, None, {"error": "ended by SIGSEGV", "exit_code": -11}),
    ],
)
def test_what_a_process_leaves_becomes_a_row(
    tmp_path: Path, code: int, results: dict[str, Any] | None, expected: dict[str, Any]
) -> None:
    (job,) = plan_in(tmp_path).jobs
    out = Path(job.out)
    out.mkdir(parents=True)
    output = f"error: no {out}/file at 0x7f3a5b6c7d8e\nwarning: left behind\n"
    (out / "output.txt").write_text(output, encoding="utf-8")
    if results is not None:
        (out / "summary.json").write_text(json.dumps(results), encoding="utf-8")
    row = read_results(job, code, 2.0)
    cells = {key: value for key, value in row.items() if key in expected}
    assert cells == {
        key: value.replace("ID", job.id) if key == "error" else value
        for key, value in expected.items()
    }
