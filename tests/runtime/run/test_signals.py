"""Ctrl-C and SIGTERM, sent to real processes: an orderly end first, an immediate one if pressed."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.runtime.tools.samples_cli import config_file, results, start, summary

pytestmark = pytest.mark.timeout(120)
CLOCKS = ["lockstep", "real"]
PACED = {
    "lockstep": "clock = 'lockstep'\nspeed = 1.0\nstall = 0",
    "real": "clock = 'real'\nstall = 0",
}


@contextmanager
def running(folder: Path, path: Path, word: str) -> Iterator[subprocess.Popen[str]]:
    """Start a run and wait until it has printed a word."""
    with start(["run", path, "-q"], folder) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == word
            yield process
        finally:
            process.kill()


def ends(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Wait for the end; return exit code and standard error."""
    _, err = process.communicate(timeout=60)
    return process.returncode, err


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGINT, "Ctrl-C"),
        pytest.param(signal.SIGTERM, "SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_a_run_in_order(
    clock: str, number: signal.Signals, reason: str, tmp_path: Path
) -> None:
    path = config_file(tmp_path, "Reader", "Lively", run=PACED[clock])
    with running(tmp_path, path, "running") as process:
        time.sleep(0.3)  # some seconds of the run's clock, so that it has something to lose
        process.send_signal(number)
        code, err = ends(process)
    assert (code, err) == (0, "")
    totals = summary(results(tmp_path))
    assert (totals["reason"], totals["error"]) == (reason, None)
    assert totals["sim_seconds"] >= 0.2
    lines = (results(tmp_path) / "pings.txt").read_text().splitlines(keepends=True)
    assert len(lines) == totals["events"]["Ping"]
    assert all(line.endswith("\n") for line in lines)


@pytest.mark.slow
def test_a_run_that_goes_as_fast_as_it_can_hears_ctrl_c(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Lively", settings="rate = 1000")
    with running(tmp_path, path, "running") as process:
        process.send_signal(signal.SIGINT)
        assert ends(process) == (0, "")
    assert summary(results(tmp_path))["reason"] == "Ctrl-C"


@pytest.mark.slow
@pytest.mark.parametrize("clock", CLOCKS)
def test_ctrl_c_during_a_slow_start_ends_in_order(clock: str, tmp_path: Path) -> None:
    path = config_file(tmp_path, "Speaker", "SlowStart", run=PACED[clock])
    with running(tmp_path, path, "starting") as process:
        process.send_signal(signal.SIGINT)
        assert ends(process) == (0, "")
    totals = summary(results(tmp_path))
    assert (totals["reason"], totals["sim_seconds"]) == ("Ctrl-C", 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("clock", CLOCKS)
def test_a_second_ctrl_c_ends_at_once(clock: str, tmp_path: Path) -> None:
    path = config_file(tmp_path, "SlowEnd", run=PACED[clock] + "\nshutdown_limit = 100")
    with running(tmp_path, path, "running") as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        assert process.stdout.readline() == "ending\n"
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        code, _ = ends(process)
    assert time.monotonic() - begin < 20
    assert code in {-signal.SIGINT, 130}


@pytest.mark.slow
def test_ctrl_c_wakes_an_idle_run(tmp_path: Path) -> None:
    for clock in CLOCKS:
        run = f"clock = '{clock}'\nshutdown_limit = 0.2"
        path = config_file(tmp_path, "SlowEnd", run=run)
        with running(tmp_path, path, "running") as process:
            process.send_signal(signal.SIGINT)
            code, err = ends(process)
        assert code == 2
        line = err.splitlines()[-1]
        assert line.startswith("error: slowend: expected on_shutdown to end within 0.2")
        assert "found it still running (runtime/samples.py:" in line


@pytest.mark.slow
def test_what_a_shell_put_into_the_background_can_be_interrupted(tmp_path: Path) -> None:
    """Shells have background processes ignore SIGINT; who sends one nevertheless means it."""
    path = config_file(tmp_path, "Reader", "Lively", run=PACED["lockstep"])
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        run = running(tmp_path, path, "running")
        process = run.__enter__()
    finally:
        signal.signal(signal.SIGINT, before)
    process.send_signal(signal.SIGINT)
    assert ends(process) == (0, "")
    run.__exit__(None, None, None)
    assert summary(results(tmp_path))["reason"] == "Ctrl-C"
