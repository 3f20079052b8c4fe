"""Every example runs as its first lines say, a little shorter."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from runtime.config import load

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))


def run(example: str, out: Path, *changes: str, code: int = 0) -> dict[str, Any]:
    """Run an example in a process of its own and return its summary."""
    settings = [word for change in changes for word in ("--set", change)]
    command = [sys.executable, "-m", "runtime", "run", f"examples/{example}.toml", "--quiet"]
    done = subprocess.run(
        [*command, "--out", str(out), *settings], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == code, done.stderr
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_is_a_right_file(path: Path) -> None:
    """Its nodes exist and its settings are valid."""
    assert load(path).nodes


def test_a_node_of_ones_own_scores_each_image(tmp_path: Path) -> None:
    """`brightness` scores what its camera sees, at the rate of the camera."""
    summary = run("brightness", tmp_path, "run.duration=2s")
    assert summary["events"]["Image"] == 20
    assert summary["events"]["Score"] == 20


def test_two_cameras_have_rates_of_their_own(tmp_path: Path) -> None:
    """`two_cameras` gives 15 coloured pairs and 70 grey pictures a second."""
    summary = run("two_cameras", tmp_path, "run.duration=2s")
    assert summary["events"]["DepthImage"] == 30
    assert summary["events"]["Image"] == pytest.approx(30 + 140, abs=2)
    assert (tmp_path / "pictures.png").stat().st_size > 10_000


def test_the_tour_of_the_yard_touches_nothing(tmp_path: Path) -> None:
    """`yard` flies its whole tour, nearly blind here, and lands without a collision."""
    blind = ["camera.width=64", "camera.height=64", "camera.rate=1", "evaluation.report=false"]
    summary = run("yard", tmp_path, *blind, "run.stall=1", code=1)
    assert summary["reason"] == "tour: tour flown"
    # Armed, taken off, landed, disarmed: no collision among what happened.
    assert summary["outputs"]["drone.happenings"] == 4


def test_computer_vision_follows_the_trajectory(tmp_path: Path) -> None:
    """`computer_vision` ends with its trajectory, having given one set of images per update."""
    summary = run("computer_vision", tmp_path, "camera.rate=5")
    assert summary["reason"] == "trajectory ended"
    assert summary["events"]["Image"] == summary["events"]["SegmentationImage"] == 61
    assert summary["events"]["Odometry"] == 61
