"""The client on a real clock: images take their time, and nobody waits for them."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[4]
RUN = """
[run]
name = "real"
clock = "real"
duration = "{seconds}s"

[[nodes]]
name = "drone"
type = "AirsimClient"
port = {port}
image_rate = {image_rate}
imu_rate = 100

[[nodes]]
name = "ticker"
type = "extensions.airsim.tests.client.ticker:Ticker"
"""


@contextlib.contextmanager
def slow_server(width: int, height: int) -> Iterator[int]:
    """Serve images that take 80 ms, in another process; yield its port."""
    command = [sys.executable, "-m", "extensions.airsim.tests.client.fake", str(width), str(height)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield int(process.stdout.readline())


def run(folder: Path, **fields: Any) -> dict[str, Any]:
    file = folder / "run.toml"
    file.write_text(RUN.format(**fields))
    command = [sys.executable, "-m", "runtime", "run", str(file), "--out", str(folder / "out")]
    subprocess.run(command, cwd=ROOT, check=True, timeout=120)
    summary: dict[str, Any] = json.loads((folder / "out" / "summary.json").read_text())
    return summary


@pytest.mark.slow
def test_images_of_80_ms_come_as_they_can_and_delay_no_tick(tmp_path: Path) -> None:
    with slow_server(640, 480) as port:
        summary = run(tmp_path, port=port, image_rate=30, seconds=6)
    sent, ticks = summary["outputs"], summary["ticks"]["ticker.control"]
    assert 10 <= sent["drone.images"] <= 80  # 80 ms each, and then they are decoded
    assert sent["drone.imu"] >= 400
    # A loop that waited for images would be 40 ms late in the middle; a busy machine is not.
    assert ticks["late_p50_us"] < 2000
    assert ticks["calls"] >= 0.8 * 400 * 6
