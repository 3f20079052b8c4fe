"""The command line, in a fresh process where that is the subject."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from runtime import Node
from runtime.summary import Summary, TickSummary
from runtime.tools.cli.inspect import layers
from tests.runtime.tools.samples_cli import (
    ROOT,
    command,
    command_here,
    config_file,
    results,
    summary,
)

pytestmark = pytest.mark.timeout(180)


HEAVY = {"cv2", "jinja2", "matplotlib", "mujoco", "nodes", "scipy", "sims", "textual", "zenoh"}
"""Packages that take long to import; the list of commands needs none of them."""


@pytest.mark.slow
def test_help_imports_no_package_that_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    code = (
        "import atexit, runpy, sys; sys.argv = ['runtime', '--help']\n"
        "atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
        "runpy.run_module('runtime', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "suite" in done.stdout
    imported = {name.partition(".")[0] for name in done.stderr.split()}
    assert "runtime" in imported
    assert not imported & HEAVY


@pytest.mark.slow
def test_a_run_leaves_a_full_summary_and_a_file_that_runs_again(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Noise", "Speaker", "Reader", run="duration = 2")
    done = command("run", path, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    first, last = done.stdout.splitlines()
    assert first.startswith("sample: 2.0 s on the lockstep clock, seed 0, in ")
    out = results(tmp_path)
    where = out.relative_to(tmp_path)
    assert re.fullmatch(r"runs/sample/\d{8}-\d{6}", str(where))
    assert last == f"results in {where}   all figures: python -m runtime show {where}"
    shown = command_here("show", "runs/sample", folder=tmp_path)
    assert "speaker.pings" in shown.stdout
    assert shown.stdout.endswith(done.stdout)
    first = summary(out)
    assert set(first) == set(Summary.__struct_fields__)
    assert (first["clock"], first["seed"], first["reason"]) == ("lockstep", 0, "duration")
    assert (first["error"], first["sim_seconds"]) == (None, 2.0)
    assert 0 <= first["wall_seconds"] < 20
    assert first["events"] == {"Ping": 40}
    assert first["drops"] == {"reader.pings": 0}
    assert set(first["ticks"]) == {"noise.speak", "speaker.speak"}
    tick = first["ticks"]["speaker.speak"]
    assert set(tick) == set(TickSummary.__struct_fields__)
    assert (tick["hz"], tick["late_max_us"], tick["missed"]) == (10.0, 0.0, 0)
    assert len((out / "pings.txt").read_text().splitlines()) == first["events"]["Ping"]
    assert (out / "log.txt").exists()
    msgspec.json.decode((out / "summary.json").read_bytes(), type=Summary)

    again = command_here("run", out / "config.toml", "--out", "again", "-q", folder=tmp_path)
    assert (again.returncode, again.stdout) == (0, "")
    assert summary(tmp_path / "again")["digest"] == first["digest"]
    other = command_here("run", path, "--set", "run.seed=1", "-q", folder=tmp_path)
    assert other.returncode == 0
    assert summary(tmp_path / "runs" / "sample" / "latest")["digest"] != first["digest"]


@pytest.mark.slow
def test_the_folder_of_an_earlier_run_is_renamed_by_its_time(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Noise", run="duration = 1")
    for seed in range(3):
        words = ["--set", f"run.seed={seed}", "--out", "runs/sample"]
        done = command_here("run", path, *words, folder=tmp_path)
        assert done.returncode == 0
        assert ("the folder of the earlier run is now runs/sample.2" in done.stderr) == (seed > 0)
    done = command_here("run", path, "--set", "run.seed=3", folder=tmp_path)
    assert "the folder of the earlier run is now runs/sample.2" in done.stderr
    listed = command_here("runs", folder=tmp_path).stdout.splitlines()[1:]
    assert [line.split()[4] for line in listed] == ["0", "1", "2", "3"]
    assert all(summary(tmp_path / line.split()[0]) for line in listed)


@pytest.mark.slow
def test_a_node_that_fails_is_one_line_and_a_summary(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Failing", run="duration = 2")
    done = command("run", path, "-q", folder=tmp_path)
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert line.startswith("error: failing: RuntimeError: out of order (runtime/samples.py:")
    assert "Traceback" not in done.stderr
    totals = summary(out := results(tmp_path))
    assert done.stderr.splitlines()[-2] == f"{out.relative_to(tmp_path)}/log.txt says more"
    assert (totals["reason"], totals["sim_seconds"]) == ("failing failed", 0.5)
    assert totals["error"] == "failing: RuntimeError: out of order"
    log = (results(tmp_path) / "log.txt").read_text()
    assert "0.500000 ERROR    runtime: failing: RuntimeError: out of order" in log
    assert "Traceback" in log


@pytest.mark.parametrize(
    ("on_error", "code"), [pytest.param("drop", 0, marks=pytest.mark.slow), ("stop", 2)]
)
def test_a_thread_that_never_returns_does_not_keep_the_process(
    on_error: str, code: int, tmp_path: Path
) -> None:
    path = config_file(tmp_path, "Failing", "Stuck", run="duration = 1\nclock = 'real'")
    done = command("run", path, "--set", f"failing.on_error={on_error}", "-q", folder=tmp_path)
    assert done.returncode == code
    lines = [line for line in done.stderr.splitlines() if not line.startswith("error: ")]
    assert lines[-1] == "warning: still busy, left behind: offload_0"
    assert summary(results(tmp_path))["sim_seconds"] > 0.5


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Speaker")
    mistakes: list[tuple[list[str | Path], str]] = [
        (["run", "none.toml"], "error: none.toml: expected a readable file, found: No such"),
        (
            ["check", path, "--set", "speaker.rte=3"],
            "sample.toml: nodes[0] (speaker): found",
        ),
        (
            ["graph", path, "--set", "speakr.rate=3"],
            'a node (speaker), found "speakr" (did you mean \'sp',
        ),
        (["show"], "error: missing argument 'folder'; `"),
        (["run"], "error: run: expected a file, or a bundle with --from"),
        (["run", path, "--sed", "3"], "error: no such option: --sed"),
        (["run", path, "--web", "x"], "error: invalid value for '--web': "),
        (["nodes", "Multirotr"], "(did you mean 'Multirotor'?)"),
    ]
    for arguments, line in mistakes:
        done = command_here(*arguments, folder=tmp_path)
        assert (done.returncode, done.stdout) == (2, "")
        assert len(done.stderr.splitlines()) == 1
        assert line in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("node", ["Fatal", "FailsLast"])
def test_an_error_is_printed_once(node: str, tmp_path: Path) -> None:
    text = f"[[nodes]]\nname = 'n'\ntype = '{__name__}:{node}'\n[run]\nduration = 0.1\n"
    (tmp_path / "f.toml").write_text(text)
    done = command("run", "f.toml", "-q", folder=tmp_path)
    assert (done.returncode, done.stderr.count("went wrong")) == (2, 1), done.stderr
    assert "went wrong" in (results(tmp_path) / "log.txt").read_text()


class Fatal(Node):
    async def run(self) -> None:
        self.log.fatal("it went wrong")


class FailsLast(Node):
    async def on_shutdown(self) -> None:
        raise OSError("it went wrong")


def test_check_says_what_is_right_and_warns_of_what_is_not_connected(tmp_path: Path) -> None:
    done = command_here("check", config_file(tmp_path, "Speaker", "Echo"), folder=tmp_path)
    assert done.returncode == 0
    assert done.stdout.rstrip().endswith("2 nodes, 1 connections: right")
    path = config_file(tmp_path, "Reader", run="duration = 1")
    done = command_here("check", path, folder=tmp_path)
    assert done.returncode == 0
    assert done.stderr == "warning: reader.pings: expects Ping, and no node sends it\n"
    assert not (tmp_path / "runs").exists()


def test_graph_prints_mermaid_or_draws(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Speaker", "Echo", "Reader")
    lines = command_here("graph", path, folder=tmp_path).stdout.splitlines()
    assert lines[0] == "flowchart LR"
    assert "    speaker -- Ping --> echo" in lines
    assert "    speaker -- Ping --> reader" in lines
    done = command_here("graph", path, "--out", "graph.png", folder=tmp_path)
    assert (done.returncode, done.stdout) == (0, "graph.png\n")
    assert (tmp_path / "graph.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ([], [["a", "b", "c", "d"]]),
        ([("a", "b"), ("b", "c"), ("a", "c"), ("a", "d")], [["a"], ["b", "d"], ["c"]]),
        ([("a", "b"), ("b", "a"), ("b", "c")], [["a", "d"], ["b"], ["c"]]),
        ([("d", "a"), ("a", "b"), ("b", "d")], [["a", "c"], ["b"], ["d"]]),
    ],
)
def test_a_graph_goes_from_senders_to_receivers(
    pairs: list[tuple[str, str]], expected: list[list[str]]
) -> None:
    assert layers(["a", "b", "c", "d"], pairs) == expected


def test_nodes_describes_ports_and_settings(tmp_path: Path) -> None:
    done = command_here("nodes", "multirotor", folder=tmp_path)
    assert done.returncode == 0
    assert "Multirotor" in done.stdout
    for line in (
        "imu  Imu (output)",
        "images  Image (output)",
        "control  at the setting control_rate",
        "imu_rate  = 200 (float, > 0, ≤ 1000)",
        "Rate of the IMU and of the ground truth (`odometry`; also at each exposure), Hz.",
    ):
        assert line in done.stdout


def test_nodes_describes_any_node_that_can_be_imported(tmp_path: Path) -> None:
    done = command_here("nodes", "tests.runtime.samples:Speaker", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "pings  Ping (output)" in done.stdout
    (tmp_path / "beside_me.py").write_text("from tests.runtime.samples import Speaker as Mine\n")
    done = command_here("nodes", "beside_me:Mine", folder=tmp_path)
    assert "pings  Ping (output)" in done.stdout, done.stderr
    done = command_here("nodes", "tests.runtime.samples:Nobody", folder=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: nodes: expected a node of tests.runtime.samples, found")


def test_settings_describes_what_every_file_may_have(tmp_path: Path) -> None:
    done = command_here("settings", folder=tmp_path)
    assert done.returncode == 0
    for line in (
        "[run]",
        "[network]",
        "[[nodes]]",
        "[nodes.links.PORT]",
        "seed  = 0 (integer, ≥ 0)",
        'on_error  = "stop" ("stop" or "restart" or "drop")',
        "loss  = 0.0 (float, ≥ 0, ≤ 1)",
    ):
        assert line in done.stdout


def test_log_events_prints_each_event_with_arrays_by_shape(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Speaker", "Painter", run="duration = 0.25")
    done = command_here("run", path, "--log", "events", "-q", folder=tmp_path)
    assert done.returncode == 0
    log = (results(tmp_path) / "log.txt").read_text()
    assert log.count("events: speaker.pings Ping speaker: count=") == 3
    assert "events: painter.images Image painter: " in log
    assert "data=uint8[4, 6, 3]" in log
    assert "count=2" in done.stderr


def test_without_arguments_it_explains_itself() -> None:
    done = command_here(folder=ROOT)
    assert "Fly a simulated vehicle" in done.stdout + done.stderr
    assert os.fspath(ROOT) not in done.stderr
