"""The examples for AirSim's scripts, with Cosys-AirSim's own client, as a user would run them."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from extensions.airsim.tests.real.environments import python_of
from extensions.airsim.tests.real.rig import Rig
from tests.runtime.tools.samples_cli import ROOT, start

EXAMPLES = "extensions/airsim/examples"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def beside(example: str, out: Path, text: str = "") -> tuple[str, Any]:
    """Run an example and its script; return what the script prints, and the run's summary.

    Args:
        example: Name of the script.
        out: Folder for the results.
        text: A script in place of the example's; PORT in it becomes the server's port.
    """
    settings = ["--set", "airsim.port=0", "--quiet", "--log", "info", "--out", str(out)]
    name = example.removesuffix("_hello")
    with start(["run", f"{EXAMPLES}/{name}.toml", *settings], ROOT) as process:
        rig = Rig(out, process)
        given = (
            ["-c", text.replace("PORT", str(rig.port))] if text else [f"{EXAMPLES}/{example}.py"]
        )
        script = [str(python_of("cosysairsim")), *given, str(rig.port)]
        done = subprocess.run(
            script, cwd=ROOT, capture_output=True, text=True, timeout=400, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, rig.end(interrupt=name == "airsim")


def test_the_lines_of_the_page_fly(tmp_path: Path) -> None:
    page = (ROOT / "extensions/airsim/docs/airsim.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"^```python\n(import cosysairsim.*?)^```", page, re.M | re.S)
    lines = lines.replace("MultirotorClient()", "MultirotorClient(port=PORT)")
    lines += "print(png[:4], len(depth.image_data_float))"
    printed, _ = beside("airsim_hello", tmp_path, lines)
    assert printed.splitlines()[-1] == "b'\\x89PNG' 36864"


def test_the_first_script_flies(tmp_path: Path) -> None:
    printed, summary = beside("airsim_hello", tmp_path)
    assert "m up: 256x144 pixels" in printed
    assert summary["outputs"]["airsim.setpoints"] > 50


def test_a_script_is_judged_and_judged_again(tmp_path: Path) -> None:
    (_, first), (_, again) = (beside("airsim_odometry", tmp_path / name) for name in "ab")
    assert first["digest"] == again["digest"]
    assert first["not_deterministic"] == []
    figures = first["verdict"]["estimators"]["odometry"]
    assert figures["ate_percent"] < 1.0
    assert figures["coverage_percent"] == 100.0
    assert figures["latency_p99_ms"] == 0.0
    assert "corners and PnP" in (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
