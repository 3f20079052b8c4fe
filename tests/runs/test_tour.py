"""The standard tour's flight as a user would start it: what it leaves, and that it is the same
each time. (Nobody judges an estimator here: see `test_verdict`.)"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
import tomli_w

from runtime.config.reading import load
from runtime.run.execute import execute
from runtime.testing import spec
from tests.runs.witness import Witness
from tests.runtime.tools.samples_cli import ROOT, command, start, summary

pytestmark = pytest.mark.timeout(120)
CONFIG = ROOT / "config.toml"
SMALL = ["camera.width=96", "camera.height=96"]
SHORT = [*SMALL, "drone.camera_processes=1", "run.duration=2s"]
BUSY = "while True: pass"


def flight(folder: Path) -> Path:
    """Write the standard tour without its estimator and report into a folder."""
    table = tomllib.loads(CONFIG.read_text())
    left_out = {"odometry", "report"}
    table["nodes"] = [node for node in table["nodes"] if node["name"] not in left_out]
    for node in table["nodes"]:
        node.pop("thresholds", None)
    path = folder / "flight.toml"
    path.write_text(tomli_w.dumps(table))
    return path


def changes(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def fly(folder: Path, out: str, *settings: str) -> str:
    """Run the tour and return its digest."""
    done = command(
        "run", flight(folder), "-q", "--out", out, *changes(*settings), folder=folder, limit=90
    )
    assert done.returncode == 0, done.stderr
    return str(summary(folder / out)["digest"])


@pytest.mark.slow
def test_a_short_flight_leaves_everything(tmp_path: Path) -> None:
    fly(tmp_path, "out", *SHORT)
    out = tmp_path / "out"
    assert {p.name for p in out.iterdir()} == {
        *("summary.json", "config.toml", "log.txt", ".visnav-run"),
        *("trajectories", "evaluation", "frames"),
    }
    totals = summary(out)
    assert (totals["sim_seconds"], totals["reason"], totals["error"]) == (2.0, "duration", None)
    assert totals["events"]["Imu"] == 400
    assert set(totals["drops"].values()) <= {0}
    rows = (out / "trajectories" / "truth.tum").read_text().splitlines()
    assert len(rows) == 1 + totals["events"]["Odometry"]
    cameras = [a for a in totals["announcements"] if a["type"] == "CameraAnnouncement"]
    assert [(c["source"], c["rate"]) for c in cameras] == [("drone/camera", 30.0)]


@pytest.mark.slow
def test_images_depth_pose_and_truth_share_their_stamps() -> None:
    """At equal intervals, beside an IMU that keeps its own."""
    config = load(CONFIG, [*SHORT, "run.duration=1s"])
    nodes = (*config.nodes[:1], spec(Witness, "witness"))
    execute(type(config)(run=config.run, nodes=nodes))
    seen = {name: dict(pairs) for name, pairs in Witness.seen.items()}
    for name in ("Image", "DepthImage", "PoseStamped"):
        assert list(seen[name]) == [k * 1_000_000_000 // 30 for k in range(29)]
        assert {at - stamp for stamp, at in seen[name].items()} == {40_000_000}
    assert list(seen["Imu"]) == [k * 5_000_000 for k in range(200)]
    assert set(seen["Odometry"]) == {*seen["Imu"], *seen["Image"], 29 * 1_000_000_000 // 30}
    for name in ("Imu", "Odometry"):
        assert {at - stamp for stamp, at in seen[name].items()} == {0}


@pytest.mark.slow
def test_the_same_file_and_seed_give_the_same_events_on_a_busy_machine(tmp_path: Path) -> None:
    """Another process on each core changes when renderers answer, and nothing else."""
    settings = [*SMALL, "run.duration=4s"]
    quiet = fly(tmp_path, "quiet", *settings)
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(2)]
    try:
        loaded = fly(tmp_path, "busy", *settings)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert loaded == quiet


@pytest.mark.slow
def test_another_seed_or_number_of_renderers(tmp_path: Path) -> None:
    """A seed is another flight; how many processes render it is not."""
    settings = [*SMALL, "run.duration=3s"]
    one = fly(tmp_path, "one", *settings)
    assert fly(tmp_path, "two", *settings, "drone.camera_processes=1") == one
    assert fly(tmp_path, "other", *settings, "run.seed=2") != one
    assert fly(tmp_path, "slow", *settings, "camera.latency=80ms") != one


@pytest.mark.slow
def test_the_tour_flies_round_the_hall_and_lands(tmp_path: Path) -> None:
    """Without cameras a minute's flight takes seconds."""
    fly(tmp_path, "out", "drone.cameras=[]")
    totals = summary(tmp_path / "out")
    assert totals["reason"] == "pilot: flight completed"
    assert (totals["events"]["TakenOff"], totals["events"]["Landed"]) == (1, 1)
    assert totals["events"].get("Collision", 0) == 0
    assert 40 < totals["sim_seconds"] < 75
    rows = (tmp_path / "out" / "trajectories" / "truth.tum").read_text().splitlines()
    last = rows[-1].split()
    x, y, z = map(float, last[1:4])
    assert abs(x) < 0.2
    assert abs(y) < 0.2
    assert -0.2 < z < 0


@pytest.mark.slow
def test_the_whole_tour_with_images(tmp_path: Path) -> None:
    fly(tmp_path, "out", *SMALL)
    totals = summary(tmp_path / "out")
    assert totals["reason"] == "pilot: flight completed"
    assert totals["events"].get("Collision", 0) == 0
    assert abs(totals["events"]["Image"] - 30 * totals["sim_seconds"]) < 4


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_ctrl_c_in_mid_flight_leaves_whole_files(clock: str, tmp_path: Path) -> None:
    settings = changes(*SMALL, f"run.clock={clock}", "run.speed=1.0")
    trajectory = tmp_path / "out" / "trajectories" / "truth.tum"
    with start(["run", flight(tmp_path), "-q", "--out", "out", *settings], tmp_path) as process:
        deadline = time.monotonic() + 30
        # The file grows by blocks as the vehicle flies; only its growth shows from outside.
        while not trajectory.exists() or trajectory.stat().st_size < 10_000:
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    totals = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (totals["reason"], totals["error"]) == ("Ctrl-C", None)
    text = trajectory.read_text()
    assert text.endswith("\n")
    assert len(text.splitlines()) == 1 + totals["events"]["Odometry"]
    assert all(len(line.split()) == 8 for line in text.splitlines()[1:])
    assert (tmp_path / "out" / "evaluation" / "verdict.json").exists()
