"""A flight that was recorded, and flown again on the recording, by the command line."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from nodes.data.mcap.mcap_file import contents, read
from nodes.data.replay.bags import Recorded
from nodes.data.replay.reader import Timed
from runtime.channels.wire import pack

ROOT = Path(__file__).parents[4]


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "runtime", *words]


def run(example: str, out: Path, *changes: str) -> dict[str, Any]:
    """Run an example in a process of its own and return its summary."""
    settings = [word for change in changes for word in ("--set", change)]
    words = command("run", f"examples/{example}.toml", "--quiet", "--out", str(out), *settings)
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


@pytest.mark.slow
def test_an_estimator_says_of_a_recording_what_it_said_in_flight(tmp_path: Path) -> None:
    """To the byte; and a recording of the recording has all events at their times once more."""
    live, again, told = tmp_path / "live", tmp_path / "again", tmp_path / "told"
    run("record", live, "run.duration=4s", "report.figures=[]")
    file = live / "recording.mcap"
    run("replay", again, f"replay.file={file}", "report.figures=[]")
    name = "trajectories/odometry.tum"
    assert (live / name).read_bytes() == (again / name).read_bytes()
    assert (live / name).read_text().count("\n") > 70
    copy = tmp_path / "copy.toml"
    copy.write_text(
        '[[nodes]]\nname = "recorder"\ntype = "McapRecorder"\n'
        '[[nodes]]\nname = "replay"\ntype = "Replay"\nonly = ["Event"]\n'
        f'file = "{file}"\n'
    )
    done = subprocess.run(command("run", str(copy), "--quiet", "--out", str(told)), cwd=ROOT)
    assert done.returncode == 0
    assert said(told / "recording.mcap") == said(file)


def said(path: Path) -> list[tuple[int, bytes]]:
    """Return all events of a recording with their times; of images, a fingerprint."""
    reader = Recorded(path)
    events = [Timed(0, a) for a in reader.announcements()]
    events += reader.events(0, None, lambda _, __: True)
    assert reader.trouble == []
    return [(time, hashlib.sha256(pack(event).frame()).digest()) for time, event in events]


@pytest.mark.slow
def test_a_flight_that_is_killed_is_read_but_for_its_last_second(tmp_path: Path) -> None:
    """Even if the process that writes is killed as well; ``recover`` then makes the file whole."""
    words = command("run", "examples/record.toml", "--quiet", "--out", str(tmp_path))
    path, truth = tmp_path / "recording.mcap", tmp_path / "trajectories" / "truth.tum"
    flight = subprocess.Popen([*words, "--set", "run.speed=1.0"], cwd=ROOT, start_new_session=True)
    while not truth.exists() or truth.stat().st_size < 50_000:  # about 3 s of it
        assert flight.poll() is None
        time.sleep(0.05)  # for another process
    tasks = Path(f"/proc/{flight.pid}/task").glob("*/children")  # a thread started it
    children = [int(pid) for task in tasks for pid in task.read_text().split()]
    writers = [
        pid for pid in children if b"recorder.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    assert len(writers) == 1
    os.kill(flight.pid, signal.SIGKILL)
    for pid in writers:
        os.kill(pid, signal.SIGKILL)
    flight.wait()
    last = float(truth.read_text().splitlines()[-1].split()[0])
    times = [record.time for record in read(path, damaged=lambda _: None)]
    assert times[-1] / 1e9 > last - 1.0
    done = subprocess.run(command("recover", str(path)), cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{len(times)} messages, now with an index" in done.stdout
    assert contents(path).complete
    assert [record.time for record in read(path)] == times
