"""The example runs as its first lines say, a little shorter."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.tools.cli.inspect import example_files
from tests.examples.test_examples import ROOT, run
from tests.runtime.ports import free_port


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("first", [0, 1])
def test_two_machines_start_in_either_order(tmp_path: Path, clock: str, first: int) -> None:
    """`two_machines` runs as two processes, whichever comes first, as it does in one."""
    changes = ["run.duration=4s", f"run.clock={clock}", f"network.meet=tcp/127.0.0.1:{free_port()}"]
    settings = [word for change in changes for word in ("--set", change)]
    command = [
        sys.executable,
        "-m",
        "runtime",
        "run",
        str(example_files()["two_machines"]),
        "--quiet",
    ]
    groups = ["drone,pilot", "odometry,evaluation"]
    started = []
    for only in groups if first == 0 else reversed(groups):
        out = ["--only", only, "--out", str(tmp_path / only)]
        process = subprocess.Popen(
            [*command, *settings, *out], cwd=ROOT, stderr=subprocess.PIPE, text=True
        )
        started.append(process)
    for process in started:
        _, said = process.communicate(timeout=150)
        assert process.returncode == 0, said
    one, other = (json.loads((tmp_path / only / "summary.json").read_text()) for only in groups)
    assert one["digest"] == other["digest"]
    assert one["events"]["PoseEstimate"] > 30
    if clock == "lockstep":
        assert one["digest"] == run("two_machines", tmp_path / "alone", *changes)["digest"]
