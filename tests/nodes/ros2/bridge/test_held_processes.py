"""The example's estimator as a process of its own: judged to the same digest, and killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.nodes.ros2.bridge.network import bridged_run, free_port
from tests.nodes.ros2.bridge.outside import Outside

pytest.importorskip("zenoh_ros2_sdk")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[4]
SMALL = ("camera.width=160", "camera.height=120", "report.figures=[]", "run.startup_limit=300s")


@contextmanager
def started(*command: str, **environment: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        env=os.environ | environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


@contextmanager
def judged(
    folder: Path, *changes: str, hold: str = "{}"
) -> Iterator[tuple[subprocess.Popen[str], subprocess.Popen[str]]]:
    """Start the example's run and its estimator, which is not the run's to start here."""
    text = (ROOT / "examples" / "outside_ros2.toml").read_text()
    before, _, after = text.partition('[[nodes]]\nname = "estimator"')
    text = before + "[[nodes]]" + after.partition("[[nodes]]")[2]
    text = text.replace('latency = "15ms"', f'latency = "15ms"\nhold = {hold}')
    folder.mkdir()
    (folder / "run.toml").write_text(text)
    endpoint = json.dumps([f"tcp/127.0.0.1:{free_port()}"])
    settings = [word for change in (*SMALL, *changes) for word in ("--set", change)]
    run = ["-m", "runtime", "run", str(folder / "run.toml"), "--out", str(folder / "out")]
    override = f"connect/endpoints={endpoint}"
    with (
        started(*run, "--set", f"ros2.listen={endpoint}", *settings) as running,
        started("examples/outside_ros2.py", ZENOH_CONFIG_OVERRIDE=override) as estimator,
    ):
        yield running, estimator


def summary(folder: Path) -> Any:
    return json.loads((folder / "out" / "summary.json").read_text())


def fly(folder: Path) -> Any:
    with judged(folder, "run.duration=5s") as (run, _):
        output, _ = run.communicate(timeout=400)
    assert run.returncode in {0, 1}, output  # it is not about how good it is
    return summary(folder)


def test_it_is_judged_to_the_same_digest_also_with_both_cores_busy(tmp_path: Path) -> None:
    quiet = fly(tmp_path / "quiet")
    with started("-c", "while True: pass"), started("-c", "while True: pass"):
        busy = fly(tmp_path / "busy")
    answers = quiet["outside"]["slam"]
    assert answers["answered"] + answers["empty"] == answers["sent"] > 100
    assert answers["answered"] > 100
    assert answers["reproducible"]
    assert answers["inputs"] == busy["outside"]["slam"]["inputs"]
    assert quiet["digest"] == busy["digest"]


@pytest.mark.parametrize(("policy", "code"), [("error", 2), ("lost", 1), ("continue", 1)])
def test_killing_it_has_the_policy_s_result_within_a_second(
    policy: str, code: int, tmp_path: Path
) -> None:
    log = tmp_path / "run" / "out" / "log.txt"
    hold = f'{{ on_missing = "{policy}", max_wait = "100s" }}'
    pace = "run.duration=12s", "run.speed=1.0"  # so that it is killed while it flies
    with judged(tmp_path / "run", *pace, hold=hold) as (run, estimator):
        assert run.stdout is not None
        next(line for line in run.stdout if " frames" in line and " 0 frames" not in line)
        estimator.kill()
        begin = time.monotonic()
        while "nobody publishes /slam/pose any more" not in log.read_text():
            assert time.monotonic() < begin + 30.0
            time.sleep(0.02)  # it is said in another process
        taken = time.monotonic() - begin
        output = run.stdout.read()
        assert run.wait(60) == code, output
    assert taken < 1.0
    if policy != "error":
        counts = summary(tmp_path / "run")["outside"]["slam"]
        assert counts["lost"] > 0
        assert counts["answered"] > 0


def test_the_run_of_the_example_starts_it(tmp_path: Path) -> None:
    endpoint = json.dumps([f"tcp/127.0.0.1:{free_port()}"])
    command = json.dumps([sys.executable, "outside_ros2.py"])
    changes = (*SMALL, f"ros2.listen={endpoint}", f"estimator.command={command}")
    settings = [word for change in (*changes, "run.duration=3s") for word in ("--set", change)]
    run = ["-m", "runtime", "run", "examples/outside_ros2.toml", "--out", str(tmp_path / "out")]
    with started(*run, *settings) as running:
        output, _ = running.communicate(timeout=400)
    assert running.returncode in {0, 1}, output
    counts = summary(tmp_path)["outside"]["slam"]
    assert counts["answered"] + counts["empty"] == counts["sent"] > 80


REAL = """
[[nodes.subscriptions]]
topic = "/slam/pose"
type = "geometry_msgs/msg/PoseStamped"
as = "estimate"
source = "slam"
answers_to = "drone/camera"
timeout = 60.0
"""


def test_in_real_time_nothing_is_held_and_the_run_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with bridged_run(folder, enough=1, more=REAL) as (run, port):
        stub = Outside("at_once", connect=f"tcp/127.0.0.1:{port}")
        try:
            output, _ = run.communicate(timeout=100)
        finally:
            stub.leave()
    assert run.returncode == 0, output
    counts = json.loads((folder / "summary.json").read_text())["outside"]["slam"]
    assert counts["answered"] > 0
    assert counts["why_not"] == ["the clock is real"]
    heard = json.loads((folder / "heard.json").read_text())
    assert heard["PoseEstimate"]["source"] == "slam"
