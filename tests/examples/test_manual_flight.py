"""Flying by hand, with a real window on a display of our own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.nodes.viewers.window.display import DEADLINE, Display, eventually

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "runtime", "run", "examples/manual_flight.toml", "--log", "events"]
SMALLER = ["--set", "drone.cameras.front.width=96", "--set", "drone.cameras.front.height=96"]


@pytest.mark.slow
def test_held_keys_move_the_drone_on_both_axes(display: Display, tmp_path: Path) -> None:
    """Take off with t, hold w and d: it flies ahead and to the right; closing the window ends."""
    log = tmp_path / "log.txt"
    out = tmp_path.with_name(f"{tmp_path.name}.txt")  # a run takes an empty folder only
    with out.open("w") as output:
        process = subprocess.Popen(
            [*COMMAND, "--out", str(tmp_path), *SMALLER],
            cwd=ROOT,
            env=display.environment(),
            stdout=output,
            stderr=output,
        )
        try:
            fly(display, tmp_path, log)
            assert process.wait(DEADLINE) == 0, out.read_text()
        finally:
            process.kill()
            process.wait()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert "WindowClosed" in summary["reason"]
    assert summary["events"]["KeyPressed"] == 3
    flight = np.loadtxt(tmp_path / "trajectories" / "truth.tum")
    north, east = flight[-1, 1:3] - flight[0, 1:3]
    assert north > 0.3
    assert east > 0.3


def fly(display: Display, folder: Path, log: Path) -> None:
    """Press what a person would press, each time something else has happened."""

    def said(what: str) -> bool:
        return log.exists() and what in log.read_text()

    assert eventually(lambda: said("drone.images"))
    window = display.call("xdotool", "search", "--sync", "--name", "drone|visnav|keyboard")
    display.call("xdotool", "windowfocus", "--sync", window.splitlines()[0])
    display.call("xdotool", "key", "t")
    assert eventually(lambda: said("TakenOff"))
    display.call("xdotool", "keydown", "w", "keydown", "d")

    def moved() -> bool:
        rows = (folder / "trajectories" / "truth.tum").read_text().splitlines()[1:-1]
        return bool(rows) and min(float(x) for x in rows[-1].split()[1:3]) > 0.4

    assert eventually(moved)
    display.call("xdotool", "keyup", "w", "keyup", "d")
    display.ask_to_close(int(window.splitlines()[0]))
