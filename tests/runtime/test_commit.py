"""The commit in results is this project's, wherever a command is called."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from runtime import commit as module
from runtime.commit import commit, of_repository

HASH = "[0-9a-f]{7,40}"


@pytest.fixture(autouse=True)
def _ask_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests share one answer of git."""
    monkeypatch.setattr(module, "of_repository", of_repository)


def repository(folder: Path, *files: str) -> None:
    """Make a repository with files."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text("x")
    who = ["-c", "user.name=a", "-c", "user.email=a"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "a", "--allow-empty"]):
        subprocess.run(["git", *words], cwd=folder, check=True)


def test_a_file_has_the_commit_of_its_own_repository(tmp_path: Path) -> None:
    repository(tmp_path / "own", "package/a.py")
    file = tmp_path / "own" / "package" / "a.py"
    revision = of_repository(file)
    assert re.fullmatch(HASH, revision)
    file.write_text("y")
    assert of_repository(file) == f"{revision}-dirty"
    assert of_repository(tmp_path / "none.py") == ""


def test_an_environment_within_somebodys_checkout_is_none_of_it(tmp_path: Path) -> None:
    repository(tmp_path, "a.py")
    site = tmp_path / ".venv" / "site-packages" / "runtime"
    site.mkdir(parents=True)
    (site / "commit.py").write_text("")
    assert of_repository(site / "commit.py") == ""


def test_where_a_command_is_called_and_a_hook_of_git_play_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = commit()
    assert re.search(HASH, expected)
    repository(tmp_path / "other", "b.py")
    monkeypatch.chdir(tmp_path / "other")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "other" / ".git"))
    assert commit() == expected


def test_an_installed_tool_knows_the_commit_of_its_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So does a wheel that is built from an unpacked archive, where there is no repository."""
    expected = commit()
    for name in ("archive", "built"):
        module.write_commit(tmp_path / name)
        assert (tmp_path / name / "commit.txt").read_text() == f"{expected}\n"
        monkeypatch.setattr(module, "__file__", str(tmp_path / name / "commit.py"))
        monkeypatch.setattr(module, "RECORD", tmp_path / name / "commit.txt")
        assert commit() == expected
    (tmp_path / "built" / "commit.txt").unlink()
    assert commit() == ""
