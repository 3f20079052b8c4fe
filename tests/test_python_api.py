"""Runs, sweeps and judgements from Python, as a notebook, a script or a thread asks for them."""

from __future__ import annotations

import ast
import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import visnav
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.errors import ConfigError, NodeError, ResultsError, VisnavError
from tests.runtime.samples import Noise, Reader
from tests.runtime.tools.samples_cli import ROOT, command_here, config_file, results
from tests.runtime.tools.samples_cli import summary as summary_of

TABLE: dict[str, Any] = {
    "run": {"name": "table", "duration": 1},
    "nodes": [{"name": "noise", "type": Noise}, {"name": "reader", "type": Reader}],
}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    yield
    assert not [t for t in threading.enumerate() if t.name.startswith("run ")]


@pytest.mark.slow
def test_importing_it_imports_next_to_nothing() -> None:
    """So that it can tell whose `runtime` is there, and costs nothing before the first call."""
    code = "import sys, visnav; print(*{name.partition('.')[0] for name in sys.modules})"
    words = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    heavy = {"numpy", "msgspec", "rich", "typer", "matplotlib", "asyncio", "runtime", "events"}
    assert heavy & set(done.stdout.split()) == set()


@pytest.mark.slow
def test_a_run_is_that_of_the_command(tmp_path: Path) -> None:
    file = config_file(tmp_path, "Noise", "Reader", run="duration = 1")
    run = visnav.run(file, set={"run.seed": 3}, quiet=True)
    assert (run.name, run.folder) == ("sample", results(Path()))
    assert (run.passed, run.figures, run.truth, run.estimates, run.report) == (
        *(None, {}, None),
        *({}, None),
    )
    done = command_here("run", file, "--set", "run.seed=3", "-q", "--out", "b", folder=tmp_path)
    assert done.returncode == 0
    assert run.summary["digest"] == summary_of(tmp_path / "b")["digest"]
    assert visnav.load("b").summary["digest"] == run.summary["digest"]
    assert visnav.run(file, seed=4, quiet=True).summary["digest"] != run.summary["digest"]
    assert run.folder is not None
    assert visnav.load(run.folder).summary == run.summary  # it is as it was
    assert len(list(Path("runs/sample").glob("2*"))) == 2


@pytest.mark.slow
async def test_a_loop_may_be_running_here_as_in_a_notebook() -> None:
    ticks = 0

    async def tick() -> None:
        nonlocal ticks
        while True:
            ticks += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(tick())
    assert visnav.run(TABLE, quiet=True).summary["reason"] == "duration"
    await asyncio.to_thread(visnav.run, TABLE, quiet=True)
    assert ticks > 0
    task.cancel()


def test_a_table_may_have_classes_paths_and_arrays(tmp_path: Path) -> None:
    rate = {"name": "speaker", "type": "tests.runtime.samples:Speaker", "rate": np.float64(20)}
    table = TABLE | {"nodes": [*TABLE["nodes"], rate]}
    run = visnav.run(table, set={"speaker.text": tmp_path}, seed=1, out="x", quiet=True)
    assert run.summary["outputs"]["speaker.pings"] == 20
    assert "name" in TABLE["nodes"][0]  # it was left as it is


@pytest.mark.slow
def test_threads_run_side_by_side() -> None:
    runs: dict[int, visnav.Run] = {}

    def fly(seed: int) -> None:
        runs[seed] = visnav.run(TABLE, seed=seed, out=f"seed{seed}", quiet=True)

    threads = [threading.Thread(target=fly, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({run.summary["digest"] for run in runs.values()}) == 3
    assert not any("no monitor" in Path(f"seed{n}/log.txt").read_text() for n in runs)
    assert runs[1].summary["digest"] == visnav.run(TABLE, seed=1, quiet=True).summary["digest"]


def test_what_is_wrong_is_raised_here(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"config: nodes\[0\] \(noise\): .*rat"):
        visnav.run({"nodes": [{"name": "noise", "type": Noise, "rat": 1}]})
    with pytest.raises(ConfigError, match=r"--set nois\.e=1: expected run or a node"):
        visnav.run(TABLE, set={"nois.e": 1})
    with pytest.raises(ResultsError, match=r"expected the folder of a run, .*found none"):
        visnav.load(tmp_path / "nowhere")
    file = config_file(tmp_path, "Noise", "Failing", run="duration = 1")
    with pytest.raises(NodeError, match="out of order"):
        visnav.run(file, quiet=True)
    failed = visnav.load("runs/sample")  # what it has recorded is there
    assert "out of order" in failed.summary["error"]
    assert failed.summary["outputs"]["noise.pings"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("when", ["running", "starting"])
def test_ctrl_c_ends_the_run_in_order_and_then_the_script(when: str, tmp_path: Path) -> None:
    node = {"running": "Lively", "starting": "SlowStart"}[when]
    file = config_file(tmp_path, "Noise", node, run="clock = 'real'")
    script = tmp_path / "script.py"
    script.write_text(
        f"import visnav\nvisnav.run({str(file)!r}, out='out', quiet=True)\nprint('no')\n"
    )
    with subprocess.Popen(
        [sys.executable, "-u", str(script)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"{when}\n"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (-signal.SIGINT, "")
    assert "KeyboardInterrupt" in err
    assert summary_of(tmp_path / "out")["reason"] == "Ctrl-C"


@pytest.mark.slow
def test_a_sweep_is_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    file = config_file(tmp_path, "Noise", "Speaker", run="duration = 0.5")
    frame = visnav.sweep(file, {"speaker.rate": [10, 20.0]}, seeds=2, jobs=2)
    monkeypatch.setitem(sys.modules, "pandas", None)
    rows = visnav.sweep(file, {"speaker.rate": [10, 20.0]}, seeds=2)  # of what is finished
    assert frame.to_dict("records") == rows
    assert [(row["speaker.rate"], row["seed"]) for row in rows] == [
        *((10, 0), (10, 1)),
        *((20.0, 0), (20.0, 1)),
    ]
    assert {(row["error"], row["passed"], row["estimator"]) for row in rows} == {("", None, "")}
    assert (tmp_path / "sweeps" / "sample" / "index.html").is_file()


def curve(count: int = 400, wrong: float = 0.0) -> Trajectory:
    seconds = np.arange(count) / 20
    positions = np.stack([np.cos(seconds / 3), np.sin(seconds / 3), seconds / 9], axis=1) * 4
    positions[:, 0] += wrong * np.sin(seconds * 2)
    half = seconds / 6
    quaternions = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    return Trajectory((seconds * 1e9).round().astype(np.int64), positions, quaternions)


def rows_of(trajectory: Trajectory) -> np.ndarray:
    quaternions = trajectory.orientations[:, [1, 2, 3, 0]]
    return np.column_stack([trajectory.stamps / 1e9, trajectory.positions, quaternions])


@pytest.mark.slow
def test_arrays_trajectories_and_files_get_the_same_figures(tmp_path: Path) -> None:
    truth, estimate = curve(), curve(wrong=0.02)
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "mine.txt", estimate)
    of_files = visnav.judge("truth.txt", "mine.txt", alignment="se3")
    of_arrays = visnav.judge(rows_of(truth), {"mine": rows_of(estimate)}, alignment="se3")
    of_structs = visnav.judge(truth, estimate, alignment="se3", out="judged/here")
    assert list(of_files.figures) == list(of_arrays.figures) == ["mine"]
    assert list(of_structs.figures) == ["estimate"]
    expected = of_files.figures["mine"]
    assert 0.005 < expected["ate_rmse_m"] < 0.02
    for other in (of_arrays.figures["mine"], of_structs.figures["estimate"]):
        for name, value in expected.items():
            if isinstance(value, float):
                assert other[name] == pytest.approx(value, rel=1e-5, abs=1e-7), name
            elif name != "method":
                assert other[name] == value, name
    assert of_arrays.folder is None
    assert of_structs.report == Path("judged/here/report.html")
    assert json.loads(Path("judged/here/evaluation/verdict.json").read_bytes())["passed"] is None


def test_whoever_is_lost_for_most_of_the_sequence_does_not_look_good() -> None:
    truth = curve()
    first = truth.take(np.arange(len(truth)) < 100)
    judged = visnav.judge(truth, {"brief": first, "whole": truth}, thresholds={"ate_percent": 1})
    assert judged.passed is False
    assert judged.figures["brief"]["ate_rmse_m"] < 1e-9
    assert judged.figures["brief"]["coverage_percent"] == pytest.approx(25, abs=1)
    assert "coverage_percent: expected" in repr(judged)
    assert judged.figures["whole"]["passed"] is True
    sparse = visnav.judge(truth, first, frames=truth.stamps)
    assert sparse.figures["estimate"]["frame_coverage_percent"] == pytest.approx(25, abs=1)


def test_it_shows_itself_with_figures_and_curves() -> None:
    judged = visnav.judge(curve(), {"<mine>": curve(wrong=0.02)}, alignment="se3")
    assert repr(judged).startswith("<trajectories: <mine> not judged, ATE ")
    assert "of the path (se3)" in repr(judged)
    html = judged._repr_html_()
    assert "&lt;mine&gt;" in html
    assert "<mine>" not in html
    assert "share of the flight with poses</td><td>%</td><td>100</td>" in html
    figures = judged.show()
    assert len(figures) == 2
    figures[0].canvas.draw()
    assert judged.truth is not None
    assert judged.estimates["<mine>"].positions.shape == judged.truth.positions.shape


def test_in_a_fresh_notebook_its_figures_are_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody has asked IPython to draw figures of matplotlib, whose text it would show."""
    shown: list[dict[str, Any]] = []
    ipython, display = types.ModuleType("IPython"), types.ModuleType("IPython.display")
    vars(ipython).update(get_ipython=lambda: object(), version_info=(9, 0, 0))
    vars(display)["Image"] = dict
    vars(display)["display"] = lambda *images: shown.extend(images)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    judged = visnav.judge(curve(), {"mine": curve(wrong=0.02)}, alignment="se3")
    assert judged.show() == []
    assert len(shown) == 2
    for image in shown:
        assert image["format"] == "png"
        pixels: Any = cv2.imdecode(np.frombuffer(image["data"], np.uint8), cv2.IMREAD_COLOR)
        assert min(pixels.shape[:2]) > 100


def test_ipython_shows_its_images() -> None:
    pytest.importorskip("IPython")
    code = (
        "import visnav; from IPython.core.interactiveshell import InteractiveShell as Shell\n"
        "from IPython.utils.capture import capture_output\n"
        "shell = Shell.instance()\n"
        "with capture_output() as captured:\n"
        "    shell.run_cell('from tests.test_python_api import curve')\n"
        "    shell.run_cell('import visnav; visnav.judge(curve(), curve(wrong=0.02)).show()')\n"
        "assert [sorted(each.data) for each in captured.outputs] == [['image/png', 'text/plain']] "
        "* 2, captured.outputs\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_a_judgement_of_nonsense_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"truth: expected .* shape \(n, 8\).* found .* \(3, 7\)"):
        visnav.judge(np.ones((3, 7)), curve())
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        visnav.judge(tmp_path / "nowhere.txt", curve())
    with pytest.raises(VisnavError, match="alignment"):
        visnav.judge(curve(), curve(), alignment="best")


@pytest.mark.slow
async def test_the_notebook_runs(tmp_path: Path) -> None:
    """Cell by cell, in a loop that runs, as a notebook's does; what a cell ends with is shown."""
    page = ROOT / "docs" / "tutorial" / "fly-look-judge.ipynb"
    shown: list[Any] = []
    names: dict[str, Any] = {}
    shutil.copy(ROOT / "config.toml", tmp_path)
    for cell in json.loads(page.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            tree = ast.parse("".join(cell["source"]))
            last = tree.body.pop()
            assert isinstance(last, ast.Expr)
            exec(compile(tree, str(page), "exec"), names)
            shown.append(eval(compile(ast.Expression(last.value), str(page), "eval"), names))
    run, (error, coverage), drawn, distance, judged = shown
    assert run.passed is not None
    assert len(drawn) == 2
    assert error < 0.05
    assert coverage == 100
    assert distance < 0.1
    assert [judged.figures[name]["passed"] for name in ("all", "third")] == [True, False]


@pytest.mark.slow
def test_the_fixture_runs_in_the_tests_folder(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "from tests.runtime.samples import Noise\n"
        "def test_noise(visnav, tmp_path):\n"
        "    table = {'run': {'duration': 1}, 'nodes': [{'name': 'noise', 'type': Noise}]}\n"
        "    runs = [visnav.run(table, seed=seed) for seed in (1, 2)]\n"
        "    assert [run.folder for run in runs] == [tmp_path / 'run1', tmp_path / 'run2']\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "visnav_pytest", "test_it.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
