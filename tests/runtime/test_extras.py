"""What an error tells to install can be installed."""

from __future__ import annotations

import importlib.metadata
import tomllib
from pathlib import Path

import pytest

from runtime import extras

ROOT = Path(__file__).parents[2]


def test_a_checkout_installs_its_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for extra in project["optional-dependencies"]:
        assert extras.install_command(extra) == f"pip install -e '.[{extra}]'"


def test_a_wheel_names_the_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own name is in no index."""
    monkeypatch.setattr(extras, "_PROJECT", tmp_path / "none")
    required = ["numpy>=2.0", 'mcap>=1.6; extra == "record"', "rosbags>=0.11; extra == 'record'"]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    assert extras.install_command("record") == "pip install 'mcap>=1.6' 'rosbags>=0.11'"


def test_every_extra_that_the_code_names_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for room in ("runtime", "nodes", "sims"):
        for path in (ROOT / room).rglob("*.py"):
            for part in path.read_text(encoding="utf-8").split("install_command('")[1:]:
                assert part.split("'")[0] in project["optional-dependencies"], path
