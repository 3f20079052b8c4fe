"""A process that is killed is missed at once, named, and dealt with as its nodes' `on_error` says.

These are processes indeed: only those can be killed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from runtime.summary import Summary
from tests.runtime.ports import free_port

ROOT = Path(__file__).parents[3]
FILE = """
[run]
name = "apart"
clock = "{clock}"
duration = "{duration}"
speed = 1.0

[network]
meet = "{meet}"

[[nodes]]
name = "asker"
type = "extensions.machines.tests.samples:Asker"

[[nodes]]
name = "one"
type = "extensions.machines.tests.samples:Answerer"
on_error = "{on_error}"

[[nodes]]
name = "other"
type = "extensions.machines.tests.samples:Answerer"
on_error = "{on_error}"
"""


class Rig:
    """Starts processes of one file, and reads what they print."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "apart.toml"
        self.started: list[subprocess.Popen[str]] = []

    def write(self, *, clock: str, on_error: str, duration: str = "60s", meet: str = "") -> None:
        meet = meet or f"tcp/127.0.0.1:{free_port()}"
        self.file.write_text(
            FILE.format(clock=clock, on_error=on_error, duration=duration, meet=meet)
        )

    def start(
        self, only: str, out: str, where: str = "", python: tuple[str, ...] = ("-m", "runtime")
    ) -> subprocess.Popen[str]:
        command = [sys.executable, *python, "run", str(self.file), "--quiet"]
        command = [*where.split(), *command]
        options = ["--only", only, "--out", str(self.folder / out), "--log", "debug"]
        process = subprocess.Popen(
            [*command, *options],
            cwd=ROOT,
            text=True,
            stderr=subprocess.STDOUT,
            stdout=subprocess.PIPE,
            env=os.environ | {"COLUMNS": "300"},
        )
        self.started.append(process)
        return process

    def summary(self, out: str) -> Summary:
        return msgspec.json.decode((self.folder / out / "summary.json").read_bytes(), type=Summary)


def wait_for(process: subprocess.Popen[str], text: str) -> str:
    """Read what a process prints up to a line with this text."""
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return line
    raise AssertionError(f"it ended without {text!r}")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    for process in rig.started:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_killed_process_ends_the_run_which_says_who_it_was(rig: Rig, clock: str) -> None:
    rig.write(clock=clock, on_error="stop")
    there, here = rig.start("one,other", "there"), rig.start("asker", "here")
    wait_for(here, "Answered")
    there.kill()
    rest, _ = here.communicate(timeout=20)
    assert here.returncode == 2
    assert f"one, other: their process is gone ({os.uname().nodename}, process {there.pid})" in rest
    assert rig.summary("here").reason == "one, other lost"


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_without_a_process_that_may_be_missed_the_run_goes_on(rig: Rig, clock: str) -> None:
    rig.write(clock=clock, on_error="drop", duration="3s")
    there, here = rig.start("other", "there"), rig.start("asker,one", "here")
    wait_for(here, "source='other'")
    there.kill()
    rest, _ = here.communicate(timeout=30)
    assert here.returncode == 0
    assert "other: their process is gone" in rest
    assert "left out from here on" in rest
    summary = rig.summary("here")
    assert summary.reason == "duration"
    assert summary.outputs["asker.questions"] > 140


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("lost", ["asker", "one"])
def test_a_process_that_comes_back_takes_part_again(rig: Rig, clock: str, lost: str) -> None:
    """Also the one that the others found their way by; what time it is, it hears from them.

    And its nodes know that they do not begin with the run.
    """
    rig.write(clock=clock, on_error="restart", duration="8s")
    rig.file.write_text(
        rig.file.read_text().replace('Asker"', 'Asker"\non_error = "restart"'), encoding="utf-8"
    )
    there, here = rig.start(lost, "there"), rig.start("other,one".replace(lost, "asker"), "here")
    wait_for(there if lost == "asker" else here, "Answered")
    there.kill()
    wait_for(here, "waiting for its return")
    back = rig.start(lost, "back")
    wait_for(here, f"{lost}: back, at")
    rest, _ = here.communicate(timeout=40)
    assert here.returncode == 0, rest
    last, _ = back.communicate(timeout=20)
    assert back.returncode == 0, last
    assert "was here 1 times" in last
    assert "was here 1 times" not in rest
    summary = rig.summary("back")
    assert summary.reason == "duration"
    assert summary.outputs["asker.questions"] > 100
    assert summary.sim_seconds >= 8


@pytest.mark.parametrize("clock", [pytest.param("lockstep", marks=pytest.mark.slow), "real"])
def test_ctrl_c_in_one_process_ends_all_in_order(rig: Rig, clock: str) -> None:
    rig.write(clock=clock, on_error="stop")
    there, here = rig.start("one,other", "there"), rig.start("asker", "here")
    wait_for(here, "Answered")
    there.send_signal(signal.SIGINT)
    for process in (there, here):
        process.communicate(timeout=20)
        assert process.returncode == 0
    here_said, there_said = (
        msgspec.structs.replace(rig.summary(name), processes=[]) for name in ("here", "there")
    )
    assert here_said == there_said
    assert rig.summary("here").reason == "Ctrl-C"
