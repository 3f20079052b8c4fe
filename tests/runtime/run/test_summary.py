"""What a run says about itself."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from runtime import Duration, Input, Node
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.run.summarise import command_line, commit
from runtime.summary import Summary
from runtime.testing import run_nodes, spec
from runtime.tools.cli.brief import run_tables
from tests.runtime.samples import Diarist, Failing, Painter, Ping, Reader, Speaker


class Lazy(Node):
    """Reads nothing, and says what it would rather lose."""

    newest = Input(Ping, keep="latest")
    some = Input(Ping, bound=4, overflow="drop_oldest")


def run(
    tmp_path: Path, *nodes: type[Node[Any]], clock: str = "lockstep", seconds: float = 1.0
) -> Summary:
    settings = RunConfig(duration=Duration(seconds), clock=clock, seed=3)  # type: ignore[arg-type]
    specs = tuple(spec(n, n.__name__.lower()) for n in nodes)
    return execute(Config(run=settings, nodes=specs), tmp_path)


def test_everything_is_counted(tmp_path: Path) -> None:
    found = run(tmp_path, Speaker, Lazy, Painter)
    assert found.events == {"Image": 1, "Ping": 10}
    assert found.outputs == {"speaker.pings": 10, "painter.images": 1}
    assert found.drops == {"lazy.newest": 9, "lazy.some": 6}
    assert (found.streams["lazy.some"].bound, found.streams["lazy.some"].peak) == (4, 4)
    assert found.ticks["speaker.speak"].calls == 10
    assert (found.seed, found.reason, found.sim_seconds) == (3, "duration", 1.0)
    assert found.environment["python"]


def test_the_written_summary_is_the_returned_one(tmp_path: Path) -> None:
    found = run(tmp_path, Speaker, Reader)
    written = (tmp_path / "summary.json").read_bytes()
    assert msgspec.json.decode(written, type=Summary) == found


def test_announcements_are_kept(tmp_path: Path) -> None:
    found = run(tmp_path, Diarist)
    assert found.announcements == [{"type": "Offer", "stamp": 0, "source": "diarist"}]


def test_a_failed_run_leaves_its_summary(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="out of order"):
        run(tmp_path, Speaker, Failing)
    found = msgspec.json.decode((tmp_path / "summary.json").read_bytes(), type=Summary)
    assert found.error == "failing: RuntimeError: out of order"
    assert found.events["Ping"] in {5, 6}  # one is due as it fails


def test_real_time_is_measured(tmp_path: Path) -> None:
    found = run(tmp_path, Speaker, clock="real", seconds=0.2)
    assert 0.2 <= found.sim_seconds < 30  # at which a busy machine may get round to it
    assert 0.2 <= found.wall_seconds < 30
    tick = found.ticks["speaker.speak"]
    assert 0 < tick.late_p50_us <= tick.late_p99_us <= tick.late_max_us


def test_the_tables_show_every_output_input_and_tick(tmp_path: Path) -> None:
    found = run(tmp_path, Speaker, Lazy)
    cells = {cell for t in run_tables(found) for c in t.columns for cell in c.cells}
    assert {"speaker.pings", "10.0", "lazy.some", "6", "speaker.speak"} <= cells


@pytest.mark.slow
def test_the_digest_is_of_what_was_said(tmp_path: Path) -> None:
    one, two = run(tmp_path, Speaker), run(tmp_path, Speaker)
    assert one.digest == two.digest
    assert one.digest != run(tmp_path, Speaker, Painter).digest


def test_a_result_for_tests_counts_drops_too() -> None:
    result = run_nodes([spec(Speaker, "s"), spec(Lazy, "lazy")])
    assert result.drops["lazy.some"].dropped == 6


def test_the_command_line_is_kept_without_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["run", "a b.toml", "--set", "network.secret=abc", "network.secret=file:key"]
    monkeypatch.setattr(sys, "orig_argv", ["/opt/bin/python3", "-m", "runtime", *arguments])
    shown = command_line()
    assert shown.startswith("python3 -m runtime run 'a b.toml' --set ")
    assert "abc" not in shown
    assert "network.secret=file:key" in shown


def test_the_commit_is_that_of_the_folder_if_there_is_one(tmp_path: Path) -> None:
    assert commit(tmp_path) == ""
    for command in (
        ["init", "-q"],
        ["-c", "user.name=a", "-c", "user.email=a", "commit", "-q", "--allow-empty", "-m", "a"],
    ):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    assert re.fullmatch("[0-9a-f]{7,40}", commit(tmp_path))
