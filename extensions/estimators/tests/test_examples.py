"""The examples with other people's estimators, a little shorter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from runtime.tools.cli.inspect import example_files
from tests.examples.test_examples import ROOT, run


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_svo_is_judged_beside_our_odometry(tmp_path: Path) -> None:
    """`svo` at the beginning of its tour: both have begun, and know where they are."""
    pytest.importorskip("svo_cpp")
    changes = "run.duration=10s", "report.figures=[]", "evaluation.thresholds.coverage_percent=60"
    figures = run("svo", tmp_path, *changes)["verdict"]["estimators"]
    assert all(figures[name]["ate_percent"] < 0.5 for name in ("svo", "odometry"))
    assert figures["svo"]["lost_count"] == 1  # before it began


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_pipelines_of_evalio_answer_every_scan(tmp_path: Path) -> None:
    """`evalio`: centimetres, but for the height of KISS-ICP, which it loses as it takes off."""
    pytest.importorskip("evalio")
    figures = run("evalio", tmp_path, "report.figures=[]")["verdict"]["estimators"]
    assert figures.keys() == {"kiss", "ct", "dlio"}
    for name, ratings in figures.items():
        assert ratings["coverage_percent"] == 100.0
        assert max(ratings["ate_north_rmse_m"], ratings["ate_east_rmse_m"]) < 0.05
        assert ratings["ate_percent"] < (3.0 if name == "kiss" else 0.5)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_orb_slam3_takes_the_place_of_odometry(tmp_path: Path) -> None:
    """`orb_slam3` tracks all the way with a vocabulary trained on the spot."""
    pytest.importorskip("pyorbslam3")
    vocabulary = tmp_path / "vocabulary.txt"
    command = [sys.executable, "-m", "runtime", "vocabulary", str(example_files()["orb_slam3"])]
    done = subprocess.run(
        [*command, "--out", str(vocabulary)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    settings = [f'odometry.vocabulary="{vocabulary}"', "run.duration=15s"]
    summary = run("orb_slam3", tmp_path / "out", *settings, "report.figures=[]")
    assert summary["not_deterministic"] == ["odometry"]
    assert summary["verdict"]["estimators"]["odometry"]["lost_seconds"] == 0.0
    settings = [f'orb_slam3.vocabulary="{vocabulary}"', "run.duration=6s"]
    summary = run("plain", tmp_path / "plain", *settings, "report.figures=[]", code=1)
    frames = {n: e["frame_id"] for n, e in summary["verdict"]["estimators"].items()}
    assert frames == {"odometry": "map", "orb_slam3": "odom"}, "it begins in the air"
