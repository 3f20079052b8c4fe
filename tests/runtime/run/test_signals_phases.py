"""Signals × phases × clocks: each run ends soon, in order, with its results and its reason."""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from unittest import mock

import pytest

from runtime.tools.cli import main
from tests.runtime.tools.samples_cli import ROOT, results, start, summary

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
CLOCKS = ["lockstep", "real"]
SIGNALS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}
PHASES = ["start", "wait", "busy", "offload", "tick", "shutdown"]
LONGEST = 30.0
"""Seconds from the start or a signal to what follows, on a machine that may be busy."""


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


def run_all(folder: Path, clock: str, phases: list[str]) -> None:
    """Do a run for each phase, one after the other; called in a process of its own."""
    for number, phase in enumerate(phases):
        here = folder / f"{number}"
        here.mkdir()
        err, code = io.StringIO(), 0
        with (
            mock.patch.object(sys, "argv", ["runtime", "run", f"{file(here, clock, phase)}", "-q"]),
            contextlib.chdir(here),
            contextlib.redirect_stderr(err),
        ):
            try:
                main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 99
        print(json.dumps([code, err.getvalue()]), flush=True)


def next_line(process: subprocess.Popen[str]) -> str:
    """Return what a process prints next; it prints no more than a line before it is answered."""
    assert process.stdout is not None
    assert select.select([process.stdout], [], [], LONGEST)[0], "it says nothing"
    return process.stdout.readline().strip()


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("clock", CLOCKS)
def test_a_signal_ends_a_run_in_any_phase(
    clock: str, number: signal.Signals, tmp_path: Path
) -> None:
    """108 trials in all, at moments that a seed chooses."""
    phases, random = PHASES * 3, Random(f"{clock} {number}")
    code = (
        "import sys; from pathlib import Path; "
        "from tests.runtime.run.test_signals_phases import run_all; "
        "run_all(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path), clock, *phases],
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            for trial, phase in enumerate(phases):
                assert next_line(process) == phase
                time.sleep(random.uniform(0.0, 0.2))  # real: it is real signals
                process.send_signal(number)
                assert json.loads(next_line(process)) == [0, ""], (trial, phase)
                out = results(tmp_path / f"{trial}")
                in_shutdown = phase == "shutdown"  # its end was asked for already
                assert summary(out)["reason"] == ("enough" if in_shutdown else SIGNALS[number])
                assert (out / "first.txt").exists()
                assert (out / "first.after").exists()
            assert process.wait(LONGEST) == 0
        finally:
            process.kill()


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
