"""The command ``vslamlab``, with a stub of its contract that does what it is told, or does not."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

from nodes.judging.commands import arguments, vslamlab
from runtime.errors import ConfigError
from tests.nodes.trajectory.samples import walk

STUB = """
import os, pathlib, random, subprocess, sys, time

behaviour, *words = sys.argv[1:]
if words[0].startswith("--"):
    given = {key.lstrip("-"): value for key, value in zip(words[::2], words[1::2], strict=True)}
    name = given["exp_it"]
else:
    given = dict(word.split(":", 1) for word in words)
    name = given["exp_id"]
print("mode", given["mode"])
sequence = pathlib.Path(given["sequence_path"])
assert pathlib.Path(given["calibration_yaml"]).is_file()
stamps = {row.split(",")[0] for row in pathlib.Path(given["rgb_csv"]).read_text().splitlines()[1:]}
out = pathlib.Path(given["exp_folder"]) / f"{name}_KeyFrameTrajectory.csv"
failing = behaviour.endswith("once") and name != "00001"
if behaviour.startswith("hang") and not failing:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (out.parent / "child").write_text(str(child.pid))
    time.sleep(600)
if behaviour.startswith("crash") and not failing:
    print("no such vocabulary")
    os.abort()
if behaviour == "nothing":
    sys.exit(0)
random.seed(name)
rows = []
for row in (sequence / "groundtruth.csv").read_text().splitlines()[1:]:
    stamp, *numbers = row.split(",")
    if stamp in stamps and int(stamp) // 100_000_000 % 5 == 0:  # key frames
        place = [float(v) * 2.0 + random.gauss(0, 0.02) for v in numbers[:3]]
        rows.append(",".join([stamp, *map(str, place), *numbers[3:]]))
if behaviour == "few":
    rows = rows[:1]
if behaviour == "another flight":
    rows = ["2" + row[1:] for row in rows]
text = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\\n" + "\\n".join(rows) + "\\n"
out.write_text("garbage" if behaviour == "garbage" else text)
"""


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Write what an export makes, without the images, and the stub beside it."""
    folder = tmp_path / "vslamlab"
    folder.mkdir()
    head, rows = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n", ""
    images = "ts_rgb_0 (ns),path_rgb_0\n"
    for stamp, place, (w, *turn) in walk(300).poses():
        stamp += 1_577_836_800 * 10**9
        rows += f"{stamp},{','.join(map(str, (*place, *turn, w)))}\n"
        images += f"{stamp},rgb_0/{stamp}.png\n"
    (folder / "groundtruth.csv").write_text(head + rows)
    (folder / "rgb.csv").write_text(images)
    (folder / "calibration.yaml").write_text("%YAML 1.2\n")
    (tmp_path / "stub.py").write_text(STUB)
    return folder


def judged(sequence: Path, behaviour: str, *words: str) -> tuple[Result, dict[str, Any]]:
    """Run the command; return its result and the verdict."""
    out = sequence.parent / "judged"
    app = typer.Typer()
    app.command()(vslamlab)
    stub = ["--", sys.executable, str(sequence.parent / "stub.py"), behaviour]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nodes.judging.judged.write_report", lambda out: out / "report.html")
        result = CliRunner().invoke(app, [str(sequence), "--out", str(out), *words, *stub])
    path = out / "evaluation" / "verdict.json"
    verdict: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return result, verdict


@pytest.mark.slow
@pytest.mark.parametrize("style", [[], ["--dashes"]])
def test_runs_that_succeed_are_judged_with_their_spread(sequence: Path, style: list[str]) -> None:
    result, verdict = judged(sequence, "works", "--repeat", "3", *style)
    assert result.exit_code == 0, result.output
    assert [*verdict["estimators"]] == ["00000", "00001", "00002"]
    errors = [estimator["ate_rmse_m"] for estimator in verdict["estimators"].values()]
    assert all(0.0 < error < 0.05 for error in errors)
    assert len({*errors}) == 3
    assert verdict["estimators"]["00000"]["alignment"] == "sim3"
    assert verdict["estimators"]["00000"]["scale"] == pytest.approx(0.5, rel=0.02)
    assert "3 of 3 runs left a trajectory; ate_rmse_m: median" in result.output
    log = sequence.parent / "judged_runs" / "system_output_00002.txt"
    assert log.read_text() == "mode mono\n"


def test_scale_is_aligned_in_mono_only(sequence: Path) -> None:
    result, verdict = judged(sequence, "works", "--mode", "stereo")
    (figures,) = verdict["estimators"].values()
    assert figures["alignment"] == "se3"
    assert figures["ate_rmse_m"] > 0.2
    assert figures["failed"][0].startswith("rpe_1m_trans_percent: expected at most 75, found ")
    assert result.exit_code == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        ("crash-once", "no such vocabulary"),
        ("nothing", "expected 00000_KeyFrameTrajectory.csv, found none"),
        ("garbage", "expected a trajectory"),
    ],
)
def test_a_run_that_fails_is_a_row_and_fails_the_whole(
    sequence: Path, behaviour: str, why: str
) -> None:
    result, verdict = judged(sequence, behaviour, "--repeat", "2")
    assert result.exit_code == 1
    assert why in " ".join(result.output.split())
    rows = verdict["estimators"]
    assert [*rows] == ["00000", "00001"]
    assert rows["00001"]["passed"] is False
    assert "failure" in rows["00001"]
    works = behaviour.endswith("once")
    assert ("ate_rmse_m" in rows["00000"]) == works


@pytest.mark.slow
@pytest.mark.parametrize("behaviour", ["few", "another flight"])
def test_what_cannot_be_compared_passes_nothing(sequence: Path, behaviour: str) -> None:
    result, verdict = judged(sequence, behaviour)
    assert result.exit_code == 1
    assert not verdict["estimators"]["00000"]["passed"]
    assert "Traceback" not in result.output


@pytest.mark.slow
def test_a_run_that_hangs_is_ended_with_all_that_it_started(sequence: Path) -> None:
    begin = time.monotonic()
    result, verdict = judged(sequence, "hang", "--limit", "2")
    assert time.monotonic() - begin < 30
    assert result.exit_code == 1
    assert verdict["estimators"]["00000"]["failure"] == "it took more than 2 s, and was ended"
    child = int((sequence.parent / "judged_runs" / "child").read_text())
    stat = Path(f"/proc/{child}/stat")
    assert not stat.exists() or " Z " in stat.read_text()


@pytest.mark.slow
def test_what_an_earlier_experiment_left_does_not_count(sequence: Path) -> None:
    judged(sequence, "works")
    result, _ = judged(sequence, "nothing")
    assert result.exit_code == 1


def test_what_is_missing_is_said(sequence: Path) -> None:
    app = typer.Typer()
    app.command()(vslamlab)
    for words, wrong in (
        ([str(sequence), "./no_such_program"], "expected a program that can be executed"),
        ([str(sequence / "none"), sys.executable], "groundtruth.csv"),
    ):
        result = CliRunner().invoke(app, words)
        assert isinstance(result.exception, ConfigError)
        assert wrong in str(result.exception)


def test_arguments_are_those_of_the_contract(tmp_path: Path) -> None:
    run = tmp_path / "experiment" / "00003"
    colon = arguments(tmp_path / "s", run, "rgbd", "my.yaml")
    assert colon[0] == f"sequence_path:{tmp_path}/s"
    assert {"exp_id:00003", "settings_yaml:my.yaml", "verbose:0", "mode:rgbd"} < {*colon}
    dashes = arguments(tmp_path / "s", run, "rgbd", dashes=True)
    assert dashes[dashes.index("--exp_it") + 1] == "00003"
    assert "--settings_yaml" not in dashes
