"""Signals × phases × clocks: each run ends soon, in order, with its results and its reason."""

from __future__ import annotations

import itertools
import random
import signal
import time
from pathlib import Path

import pytest

from tests.runtime.samples_cli import start, summary

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]
CLOCKS = ["lockstep", "real"]
SIGNALS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}
PHASES = ["start", "wait", "busy", "offload", "tick", "shutdown"]
LONGEST = 30.0
"""Seconds from the signal to the end, on a machine that may have much else to do."""


def file(folder: Path, clock: str, phase: str) -> Path:
    path = folder / "a.toml"
    path.write_text(
        f"[run]\nname = 'a'\nclock = '{clock}'\nspeed = 1.0\nstall = 0\n"
        "[[nodes]]\nname = 'first'\ntype = 'tests.runtime.samples_faults:Witness'\n"
        "[[nodes]]\nname = 'phased'\ntype = 'tests.runtime.samples_faults:Phased'\n"
        f"phase = '{phase}'\n",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("clock", "number", "phase"), list(itertools.product(CLOCKS, SIGNALS, PHASES))
)
def test_a_signal_ends_a_run_in_any_phase(
    clock: str, number: signal.Signals, phase: str, seed: int, tmp_path: Path
) -> None:
    """108 trials, at moments that the seeds choose."""
    with start(["run", file(tmp_path, clock, phase), "-q"], tmp_path) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"{phase}\n"
            time.sleep(random.Random(seed).uniform(0.0, 0.2))  # real: it is real signals
            begin = time.monotonic()
            process.send_signal(number)
            _, err = process.communicate(timeout=LONGEST)
        finally:
            process.kill()
    assert time.monotonic() - begin < LONGEST
    found = summary(tmp_path / "runs" / "a")
    in_shutdown = phase == "shutdown"  # its end was asked for already
    assert (process.returncode, err) == (0, "")
    assert found["reason"] == ("enough" if in_shutdown else SIGNALS[number])
    assert (tmp_path / "runs" / "a" / "first.txt").exists()
    assert (tmp_path / "runs" / "a" / "first.after").exists()


@pytest.mark.parametrize("what", ["import", "load"])
def test_ctrl_c_before_a_run_is_one_line(what: str, tmp_path: Path) -> None:
    """While the command line is imported, and while the modules of a file's nodes are."""
    (tmp_path / "slow.py").write_text("import time\nprint('in', flush=True)\ntime.sleep(30)\n")
    node = "[[nodes]]\nname = 'a'\ntype = 'slow:Slow'\n"
    (tmp_path / "a.toml").write_text(node, encoding="utf-8")
    if what == "import":  # stands for any module of ours
        (tmp_path / "typer.py").write_text("import slow\n", encoding="utf-8")
    with start(["run", tmp_path / "a.toml", "-q"], tmp_path) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "in\n"
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=LONGEST)
        finally:
            process.kill()
    assert (process.returncode, err) == (130, "error: interrupted\n")
