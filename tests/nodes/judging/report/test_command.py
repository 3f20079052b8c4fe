"""The command ``report``, as the command line runs it."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import runtime.tools.cli
from nodes.judging.report.page import report
from runtime.errors import ConfigError
from tests.nodes.judging.report.folders import summary

app = typer.Typer()
app.command()(report)


def test_it_prints_the_pages_path(tmp_path: Path) -> None:
    summary(tmp_path)
    done = CliRunner().invoke(app, [str(tmp_path)], catch_exceptions=False)
    assert done.output.splitlines() == [str(tmp_path / "report.html")]


def test_what_cannot_be_written_is_one_of_our_errors(tmp_path: Path) -> None:
    summary(tmp_path)
    (tmp_path / "plots").touch()
    with pytest.raises(ConfigError, match=r"plots"):
        CliRunner().invoke(app, [str(tmp_path)], catch_exceptions=False, standalone_mode=False)


def test_a_folder_that_is_no_run_gives_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["runtime", "report", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runtime.tools.cli.main()
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"error: {tmp_path}: expected the folder of a run")
    assert said.err.count("\n") == 1
