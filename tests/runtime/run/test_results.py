"""Folders of runs: by time, or the user's; whatever happens, no earlier run's results are lost."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

import visnav
from runtime.config.model import Config, RunConfig
from runtime.errors import ConfigError, NodeError, ResultsError
from runtime.node import Node
from runtime.run import execute as execution
from runtime.run.execute import execute
from runtime.run.results import MARKER, Folder, clear, run_folder, time_of
from runtime.testing import spec
from runtime.units import Duration
from tests.runtime.samples import Speaker
from tests.runtime.tools.samples_cli import ROOT, command_here, config_file, summary


class Refuser(Node):
    """Fails in start-up, of which it leaves a trace."""

    async def on_ready(self) -> None:
        assert self.out is not None
        (self.out / "half").touch()
        raise ValueError("not today")


class Rival(Node):
    """Begins a run in the folder of its own, once that goes on."""

    async def run(self) -> None:
        assert self.out is not None
        with (
            pytest.raises(ResultsError, match=f"no other run uses.*of process {os.getpid()}, "),
            Folder(self.out),
        ):
            pass


def fly(out: Path, seed: int = 0, cls: type[Node[Any]] = Speaker, *, by_time: bool = False) -> Path:
    """Fly, and return the run's folder."""
    run = RunConfig(duration=Duration(0.1), seed=seed)
    folder = Folder(out, by_time=by_time)
    execute(Config(run=run, nodes=(spec(cls, "node"),)), folder)
    return folder.path


def flights(folder: Path) -> list[int]:
    """Return the seeds of the runs in a folder, in the order of their names and numbers."""
    places = [place for place in folder.iterdir() if not place.is_symlink()]
    return [summary(place)["seed"] for place in sorted(places, key=time_of)]


def test_each_run_has_a_folder_and_latest_is_the_last_that_flew(tmp_path: Path) -> None:
    home = tmp_path / "runs" / "tour"
    first, second = (fly(home, seed, by_time=True) for seed in (1, 2))
    assert (home / "latest").readlink() == Path(second.name)
    with pytest.raises(NodeError, match="not today"):
        fly(home, 3, Refuser, by_time=True)
    assert flights(home) == [1, 2, 3]
    assert run_folder(home) == second
    assert run_folder(first) == first
    assert "not today" in next(home.glob("*/half")).with_name("log.txt").read_text()


def test_runs_of_one_second_do_not_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that go on together, and two after one another."""
    monkeypatch.setattr("time.time", lambda: 1.75e9)
    home = tmp_path / "tour"
    threads = [
        threading.Thread(target=fly, args=(home, seed), kwargs={"by_time": True}) for seed in (1, 2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    third = fly(home, 3, by_time=True)
    names = [path.name for path in home.iterdir() if path.name != "latest"]
    (base,) = {name[:15] for name in names}
    assert sorted(names) == [base, f"{base}-2", f"{base}-3"]
    assert third.name == f"{base}-3"
    assert sorted(flights(home)) == [1, 2, 3]


KILLED = """
import os, sys
from pathlib import Path
from runtime.run.results import Folder
with Folder(Path("tour"), by_time=True) as folder:
    (folder.path / "config.toml").touch()
    if sys.argv[1] == "flown":
        folder.flown()
    os.kill(os.getpid(), 9)
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["start", "flown"])
def test_what_a_killed_run_leaves_takes_nothing_away(when: str, tmp_path: Path) -> None:
    flown = fly(tmp_path / "tour", 1, by_time=True)
    words = [sys.executable, "-c", KILLED, when]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    (killed,) = {path for path in (tmp_path / "tour").glob("2*") if path != flown}
    assert run_folder(tmp_path / "tour") == (flown if when == "start" else killed)
    assert summary(flown)["seed"] == 1
    assert fly(killed, 2) == killed  # nobody uses it any more
    assert fly(tmp_path / "tour", 3, by_time=True) == run_folder(tmp_path / "tour")


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_latest_that_is_no_link_is_left_alone(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mine = tmp_path / "tour" / "latest" / "mine"
    if kind == "file":
        mine = mine.parent
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    run = fly(tmp_path / "tour", by_time=True)
    assert f"{tmp_path / 'tour' / 'latest'} does not lead to {run.name}: it is no link" in (
        (run / "log.txt").read_text()
    )
    assert mine.read_text() == "mine"
    with pytest.raises(ResultsError, match="or one with a link latest to such a folder, found 20"):
        run_folder(tmp_path / "tour")


def test_a_link_to_a_run_that_is_gone_is_an_error(tmp_path: Path) -> None:
    run = fly(tmp_path / "tour", by_time=True)
    run.rename(tmp_path / "elsewhere")
    with pytest.raises(ResultsError, match=rf"found a link to {run.name}, which is none"):
        run_folder(tmp_path / "tour")
    with pytest.raises(ResultsError, match=r"none: expected the folder of a run.*found none"):
        run_folder(tmp_path / "none")


def test_an_earlier_run_in_the_way_is_renamed(tmp_path: Path) -> None:
    """In the user's folder, and where runs have folders by time; a start that failed, too."""
    out = tmp_path / "tour"
    fly(out, 1)
    with pytest.raises(NodeError, match="not today"):
        fly(out, 2, Refuser)
    fly(out, 3)
    assert flights(tmp_path) == [1, 2, 3]
    assert summary(out)["seed"] == 3
    run = fly(out, 4, by_time=True)
    assert summary(run_folder(out)) == summary(run)
    assert flights(out) == [4]
    assert sorted(summary(path)["seed"] for path in tmp_path.glob("tour.2*")) == [1, 2, 3]
    with pytest.raises(ResultsError, match=r"expected a new or empty folder.*found '20"):
        fly(out, 5)
    assert flights(out) == [4]


@pytest.mark.slow
def test_what_no_run_has_made_is_never_removed(tmp_path: Path) -> None:
    out = tmp_path / "run"
    for number in range(3):
        fly(out)
        (out / "notes.txt").write_text(f"{number}")
    assert sorted(path.read_text() for path in tmp_path.glob("run*/notes.txt")) == ["0", "1", "2"]


def test_a_link_given_as_the_folder_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real" / "out").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "real" / "out")
    for seed in (1, 2):
        assert fly(tmp_path / "link", seed) == tmp_path / "real" / "out"
    assert flights(tmp_path / "real") == [1, 2]
    assert summary(tmp_path / "link")["seed"] == 2


def test_two_runs_never_share_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    fly(out, 1, Rival)
    fly(out, 2, Rival)
    assert flights(tmp_path) == [1, 2]
    with (
        Folder(out),
        pytest.raises(ResultsError, match="no other run uses"),
        Folder(out, by_time=True),
    ):
        pass
    with Folder(out), pytest.raises(ResultsError, match="no other run uses"):
        clear(out)
    clear(out)
    assert [path.name for path in out.iterdir()] == [MARKER]


def test_a_folder_of_somebody_else_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    """Even if it holds a file of the runtime's names, as one's own settings."""
    (tmp_path / "plots").mkdir()
    mine = [tmp_path / "config.toml", tmp_path / "plots" / "mine.png"]
    for file in mine:
        file.write_text("mine", encoding="utf-8")
    with pytest.raises(ResultsError, match=r"expected a new or empty folder.*found 'config\.toml'"):
        fly(tmp_path)
    assert [file.read_text(encoding="utf-8") for file in mine] == ["mine", "mine"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.toml", "plots"]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
@pytest.mark.parametrize("inside", [True, False])
def test_a_marker_that_is_no_file_is_refused_at_once(
    make: Callable[[Path], None], inside: bool, tmp_path: Path
) -> None:
    """Nobody waits for somebody else to open a fifo."""
    folder = tmp_path / "out"
    folder.mkdir()
    make(folder / MARKER)
    if inside:
        (folder / "summary.json").write_text("{}")
    with pytest.raises(ResultsError, match=rf"out/{MARKER}: expected a file"), Folder(folder):
        pass
    with pytest.raises(ResultsError, match=rf"out/{MARKER}: expected a file"):
        clear(folder)


def path_of(name: bytes) -> str:
    return os.fsdecode(name)


def test_a_folder_that_is_no_utf8_is_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Libraries, JSON and TOML know no other names; OpenCV crashes at the end of the run."""
    says = r"expected a path in UTF-8, found '.*o\\xff\\xfe"
    odd = tmp_path / path_of(b"o\xff\xfe")
    with pytest.raises(ResultsError, match=says), Folder(odd):
        pass
    assert not odd.exists()
    odd.mkdir()
    config_file(odd, "Speaker")
    with pytest.raises(ConfigError, match=f"sample.toml: {says}"):
        visnav.run(odd / "sample.toml")
    monkeypatch.chdir(odd)
    with pytest.raises(ResultsError, match=says), Folder(Path("runs")):
        pass
    monkeypatch.chdir(tmp_path)
    config_file(tmp_path, "Speaker", run="duration = 0.2")
    done = command_here("run", "sample.toml", "--out", path_of(b"o\xff\xfe"), folder=tmp_path)
    assert done.returncode == 2
    assert re.fullmatch(f"error: command line: {says}'\n", done.stderr), done.stderr


def test_a_folder_of_a_run_of_an_earlier_version_is_one(tmp_path: Path) -> None:
    """Without a marker; it is read, and renamed where it is in the way."""
    out = tmp_path / "tour"
    fly(out, 1)
    (out / MARKER).unlink()
    assert run_folder(out) == out
    fly(out, 2, by_time=True)
    assert summary(run_folder(out))["seed"] == 2
    (old,) = tmp_path.glob("tour.2*")
    assert summary(run_folder(old))["seed"] == 1


def test_an_earlier_run_that_cannot_be_renamed_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a folder that is read-only; root, as whom tests may run, may write there."""
    out = tmp_path / "tour"
    fly(out, 1)

    def refuse(self: Path, target: Path) -> Path:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(ResultsError, match=r"tour: expected to write a run's results.*denied"):
        fly(out, 2)
    assert flights(tmp_path) == [1]


def test_where_nothing_can_be_written_no_run_begins(tmp_path: Path) -> None:
    path = config_file(tmp_path, "Speaker", run="duration = 0.2")
    done = command_here("run", path, folder=Path("/proc"))
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: runs: expected to write a run's results, found: ")


@pytest.mark.slow
def test_whatever_takes_a_run_takes_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The latest is meant."""
    file = config_file(tmp_path, "Speaker", "Reader", run="duration = 1")
    recorder = "[[nodes]]\nname = 'recorder'\ntype = 'McapRecorder'\n"
    file.write_text(file.read_text() + recorder)
    done = command_here("run", file, "-q", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    latest = run_folder(tmp_path / "runs" / "sample").relative_to(tmp_path)
    again = tmp_path / "again.toml"
    nodes = "[[nodes]]\nname = 'replay'\ntype = 'Replay'\nfile = 'runs/sample'\n"
    nodes += "only = ['Event']\n[[nodes]]\nname = 'reader'\ntype = 'tests.runtime.samples:Reader'\n"
    again.write_text(f"[run]\nname = 'again'\n{nodes}")
    done = command_here("run", again, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    monkeypatch.chdir(tmp_path)
    assert visnav.load("runs/sample").folder == latest
    done = command_here("report", "runs/sample", folder=tmp_path)
    assert done.stdout == f"{latest / 'report.html'}\n"
    done = command_here("export", "runs/sample", "--format", "euroc", folder=tmp_path)
    assert f"error: {latest / 'trajectories'}" in done.stderr
    truth = latest / "trajectories" / "truth.tum"
    truth.parent.mkdir()
    truth.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    words = ["--truth", "runs/sample", "--estimate", "none.tum"]
    done = command_here("judge", *words, folder=tmp_path)
    assert done.stderr == "error: none.tum: No such file or directory\n"


def test_a_run_excludes_objects_from_collection_unless_its_program_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for more, expected in ((0, ["collect", "freeze", "unfreeze"]), (1, [])):
        collector = mock.Mock()
        collector.get_freeze_count.return_value = execution._FROZEN_AT_IMPORT + more
        monkeypatch.setattr(execution, "gc", collector)
        execute(Config(run=RunConfig(duration=Duration(0.1)), nodes=(spec(Speaker, "speaker"),)))
        assert [name for name, *_ in collector.method_calls[1:]] == expected
