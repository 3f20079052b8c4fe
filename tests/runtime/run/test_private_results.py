"""What nodes write while programs run is out of the programs' sight, and never lost."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import pytest

from runtime import Node, NodeConfig, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.execute import execute
from runtime.run.private_results import private_results
from runtime.testing import spec
from runtime.units import Duration


class Judge(Node[NodeConfig]):
    """Writes the truth as it comes."""

    @every(hz=10)
    def write(self, tick: Tick) -> None:
        assert self.out is not None
        (self.out / "trajectories").mkdir(exist_ok=True)
        with (self.out / "trajectories" / "truth.tum").open("a") as file:
            file.write(f"{tick.index}\n")


class Starter(Node[NodeConfig]):
    """Looks for the truth where a program that it starts is."""

    starts_programs: ClassVar[bool] = True
    truth_files: ClassVar[list[Path]] = []
    fails: ClassVar[bool] = False

    @every(hz=10)
    def look(self, tick: Tick) -> None:
        assert self.out is not None
        type(self).truth_files += self.out.parent.rglob("truth*")
        if self.fails and tick.index == 3:
            raise ValueError("it failed")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "visnav-runtime" / "unfinished"


@pytest.mark.parametrize("fails", [False, True])
def test_the_truth_is_not_there_before_the_end_and_then_it_is(
    fails: bool, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Starter.truth_files.clear()
    monkeypatch.setattr(Starter, "fails", fails)
    settings = RunConfig(duration=Duration(1.0))
    config = Config(run=settings, nodes=(spec(Judge, "judge"), spec(Starter, "starter")))
    try:
        execute(config, tmp_path / "runs" / "one")
    except VisnavError:
        assert fails
    assert Starter.truth_files == []
    rows = (tmp_path / "runs" / "one" / "trajectories" / "truth.tum").read_text().split()
    assert rows == [str(n) for n in range(4 if fails else 10)]
    assert [*home.iterdir()] == []


KILLED = """
import os, signal, sys
from pathlib import Path
from runtime.run.private_results import private_results
with private_results(Path(sys.argv[1])) as folder:
    (folder / "truth.tum").write_text("recorded")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_run_has_recorded_is_found_again(
    home: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "config.toml").touch()
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    with caplog.at_level(logging.WARNING), private_results(tmp_path) as folder:
        (left,) = set(home.iterdir()) - {folder}
        with private_results(tmp_path):
            pass  # those of runs that go on are not called left
    said = f"what killed runs have recorded is in {home}: move or remove {left.name}\n"
    assert caplog.text.count(said) == 2
    assert (left / "truth.tum").read_text() == "recorded"
    assert left.stat().st_mode & 0o777 == 0o700


def test_files_of_before_are_replaced_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / "config.toml").touch()
    for name in ("dataset/old", "dataset/same", "programs/slam/map"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    with private_results(tmp_path) as folder:
        (folder / "dataset").mkdir()
        (folder / "dataset" / "same").write_text("new")
    assert (tmp_path / "dataset" / "same").read_text() == "new"
    assert (tmp_path / "programs" / "slam" / "map").read_text() == "before"
