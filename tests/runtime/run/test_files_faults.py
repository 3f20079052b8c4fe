"""Folders and disks that go wrong: one line, exit code 2, and nothing of anybody else's is lost."""

from __future__ import annotations

import contextlib
import os
import resource
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nodes.mapping import write_ply
from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.execute import execute
from runtime.run.results import claim, write
from runtime.testing import spec
from runtime.tools.tracing.write import tracing
from runtime.units import Duration
from tests.runtime.samples import Speaker
from tests.runtime.tools.samples_cli import ROOT, command_here, config_file, results, summary

pytestmark = pytest.mark.timeout(180)


def write_ply_here(path: Path, _: bytes) -> None:
    write_ply(path, np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), "map")


def trace_here(path: Path, _: bytes) -> None:
    run = RunConfig(duration=Duration(0.1))
    config = Config(run=run, nodes=(spec(Speaker, "node"),))
    execute(config, watch=lambda supervisor: tracing(supervisor, path, "x"))


def test_a_file_is_written_as_a_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "summary.json"
    write(file, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write(file, b"new and longer")
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    assert file.read_bytes() == b"old"


DEVICE = os.makedev(1, 7)
"""That of /dev/full, which cannot be written to."""


@pytest.mark.slow
@pytest.mark.parametrize("write", [write, write_ply_here, trace_here])
@pytest.mark.parametrize("kind", ["device", "link to a device", "fifo", "folder"])
def test_what_is_no_file_is_never_removed_nor_replaced(
    kind: str, write: Callable[[Path, bytes], object], tmp_path: Path
) -> None:
    path = real = tmp_path / "out"
    if kind == "link to a device":
        real = tmp_path / "device"
        path.symlink_to(real)
    if "device" in kind:
        try:
            os.mknod(real, 0o666 | stat.S_IFCHR, DEVICE)
        except PermissionError:
            pytest.skip("only root makes devices")
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    before = path.lstat(), real.lstat()
    with contextlib.suppress(OSError, VisnavError):
        write(path, b"new")
    after = path.lstat(), real.lstat()
    assert [(s.st_ino, s.st_rdev, s.st_mode) for s in before] == [
        (s.st_ino, s.st_rdev, s.st_mode) for s in after
    ]
    assert sorted(tmp_path.iterdir()) == sorted({path, real})


@pytest.mark.parametrize("write", [write, write_ply_here, trace_here])
def test_a_link_to_a_file_stays_one(write: Callable[[Path, bytes], object], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    write(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").stat().st_size > 0


def test_claiming_twice_is_no_mistake(tmp_path: Path) -> None:
    claim(tmp_path / "a" / "b")
    claim(tmp_path / "a" / "b")


def run_limited(
    folder: Path, *arguments: str, limit: Callable[[], None] | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "runtime", "run", "sample.toml", "--quiet", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "300", "NO_COLOR": "1"}
        | environment,
        capture_output=True,
        text=True,
        preexec_fn=limit,
        timeout=60,
    )


def no_file_longer_than(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def fails_in_one_line(done: subprocess.CompletedProcess[str], *words: str) -> None:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: ")
    assert all(word in last for word in words), last


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("x" * 300, ("expected to write a run's results", "File name too long")),
        ("sample.toml", ("expected to write a run's results", "File exists")),
        ("sample.toml/below", ("expected to write a run's results", "File exists")),
        ("/proc/none", ("expected to write a run's results",)),
        ("/dev/null", ("expected to write a run's results",)),
        (".", ("expected a new or empty folder",)),
        ("..", ("expected a new or empty folder",)),
        ("loop/on", ("expected to write a run's results",)),
    ],
)
def test_a_folder_that_cannot_be(out: str, words: tuple[str, ...], tmp_path: Path) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    config_file(folder, "Speaker", run="duration = 0.2")
    (folder / "loop").symlink_to("loop")
    fails_in_one_line(command_here("run", "sample.toml", "--out", out, folder=folder), *words)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0, 10, 100, 400, 700, 1000, 1500])
def test_a_full_disk_is_one_line_and_no_half_summary(size: int, tmp_path: Path) -> None:
    """Files may have so many bytes: too few for the settings, the summary, or what nodes write."""
    config_file(tmp_path, "Speaker", "Reader", run="duration = 200")
    done = run_limited(tmp_path, limit=no_file_longer_than(size))
    fails_in_one_line(done, "File too large")
    out = results(tmp_path)
    assert not (out / "summary.json").exists() or summary(out)["error"]


@pytest.mark.slow
def test_a_full_disk_for_the_log_alone_loses_the_log_alone(tmp_path: Path) -> None:
    config_file(tmp_path, "Failing", run="duration = 2")
    out = tmp_path / "out"
    claim(out)
    (out / "log.txt").symlink_to("/dev/full")
    done = run_limited(tmp_path, "--out", "out")
    fails_in_one_line(done, "failing: RuntimeError: out of order")
    assert "log.txt: cannot be written: No space left on device" in done.stderr
    assert summary(out)["error"] == "failing: RuntimeError: out of order"


@pytest.mark.slow
@pytest.mark.parametrize("node", ["Remover", "Replacer"])
def test_a_folder_that_goes_in_mid_run_is_made_again(node: str, tmp_path: Path) -> None:
    path = config_file(tmp_path, run="duration = 0.5")
    with path.open("a", encoding="utf-8") as file:
        file.write(f"[[nodes]]\nname = 'n'\ntype = 'tests.runtime.samples_faults:{node}'\n")
    done = run_limited(tmp_path)
    if node == "Remover":
        assert (done.returncode, done.stderr) == (0, "")
        assert summary(results(tmp_path))["reason"] == "duration"
    else:
        fails_in_one_line(done, "runs/sample", "expected to write a run's results")


@pytest.mark.slow
@pytest.mark.parametrize("where", ["x" * 120, "file", "/proc"])
def test_a_run_that_cannot_be_looked_at_goes_on(where: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    config_file(tmp_path, "Speaker", run="duration = 0.2")
    folder = where if where.startswith("/") else str(tmp_path / where)
    done = run_limited(tmp_path, XDG_RUNTIME_DIR=folder)
    assert done.returncode == 0
    assert "no monitor can connect to this run" in done.stderr
    assert "Traceback" not in done.stderr
    assert summary(results(tmp_path))["reason"] == "duration"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = " + b"9" * 5000, "expected numbers of a usual size, found: Exceeds the limit"),
        (b"a = " + b"[" * 100_000, "expected TOML, found brackets nested too deep"),
        (b"a = '\xff'", "expected UTF-8 text"),
    ],
)
def test_a_file_that_nobody_would_write_is_one_line(
    content: bytes, words: str, tmp_path: Path
) -> None:
    (tmp_path / "a.toml").write_bytes(content)
    done = command_here("check", "a.toml", folder=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert words in done.stderr


def test_a_trace_that_is_not_text_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_bytes(b'{"traceEvents": [{"name": "\xff\xfe"}]}')
    done = command_here("trace", "t.json", folder=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "expected a trace, found" in done.stderr
