"""To the byte: one file with everything in it has one digest, whatever the process is like."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

FILE = """
[run]
duration = 3
seed = 5

[[nodes]]
name = "talker"
type = "{samples}:Talker"
on_error = "restart"

[[nodes]]
name = "tuner"
type = "{samples}:Tuner"

[[nodes]]
name = "crowd"
type = "{samples}:Crowd"

[[nodes]]
name = "doubler"
type = "{samples}:Doubler"
links.heard = {{ delay = "20ms", jitter = "30ms", loss = 0.2 }}

[[nodes]]
name = "listener"
type = "{samples}:Listener"
links.hear = {{ jitter = "5ms", loss = 0.1, rate = 300 }}
"""


def digest(file: Path, seed: int) -> tuple[str, dict[str, int]]:
    """Run the file in a process of its own, with a hash seed."""
    out = file.parent / f"{seed}"
    command = [sys.executable, "-m", "runtime", "run", str(file), "--quiet", "--out", str(out)]
    subprocess.run(
        command,
        check=True,
        capture_output=True,
        timeout=120,
        env={**os.environ, "PYTHONHASHSEED": str(seed)},
    )
    summary = json.loads((out / "summary.json").read_text())
    assert summary["error"] is None
    return summary["digest"], summary["outputs"]


@pytest.mark.parametrize(
    "runs",
    [
        pytest.param(4, marks=pytest.mark.timeout(120)),
        pytest.param(20, marks=[pytest.mark.slow, pytest.mark.timeout(900)]),
    ],
)
def test_equal_runs_have_equal_digests(tmp_path: Path, runs: int) -> None:
    seeds = random.Random().sample(range(1, 1 << 31), runs)
    file = tmp_path / "all.toml"
    file.write_text(FILE.format(samples="tests.runtime.samples_everything"), encoding="utf-8")
    with ThreadPoolExecutor(4) as several:  # at a time, so that each has a busy machine
        digests = list(several.map(lambda seed: digest(file, seed), seeds))
    assert {value for value, _ in digests} == {digests[0][0]}, list(
        zip(seeds, digests, strict=True)
    )
    sent = digests[0][1]
    assert sent["crowd.words"] == 36  # all have spoken
    assert min(sent[name] for name in ("talker.words", "doubler.words", "listener.words")) > 20
