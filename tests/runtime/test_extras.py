"""What an error tells to install can be installed."""

from __future__ import annotations

import importlib.metadata
import tomllib
from pathlib import Path

import pytest

from runtime import extras
from runtime.config import reading
from runtime.errors import CommandError, ConfigError

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


_OFFERED = extras.NODES, extras.PROCESSES, extras.COMMANDS


def test_the_table_of_extensions_is_that_of_their_entry_points() -> None:
    offered = {}
    for file in (*ROOT.glob("extensions/*/pyproject.toml"), ROOT / "bench" / "pyproject.toml"):
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        points = project["entry-points"]
        suffixes = [f".{name}" for name in points.get(extras.CONFIGURATIONS, ())]
        names = [name for group in _OFFERED for name in points.get(group, ())]
        offered[file.parent.name] = (*names, *suffixes)
        assert project["name"] == f"visnav-{file.parent.name}"
        assert extras.is_ours(project["name"])
    assert offered == extras.EXTENSIONS


def test_a_node_of_an_extension_that_is_missing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, with the command that installs it; so is a file that one would read."""
    core = [offer for offer in extras.offers(extras.NODES) if offer.package == extras.OURS]
    monkeypatch.setattr(reading, "offers", lambda _: tuple(core))
    expected = "the extension visnav-airsim: pip install ./extensions/airsim"
    with pytest.raises(ConfigError, match=f"f.toml: AirsimServer is a node of {expected}"):
        reading.find_node("AirsimServer", "f.toml")
    monkeypatch.setattr(reading, "offers", lambda _: ())
    with pytest.raises(ConfigError, match=f"settings.json: .json is read by {expected}"):
        reading.load_configuration(Path("settings.json"))


def test_an_extension_that_a_run_needs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "_installed", lambda: importlib.metadata.EntryPoints())
    expected = r"expected the extension visnav-machines: pip install \./extensions/machines"
    with pytest.raises(CommandError, match=expected):
        extras.extension(extras.PROCESSES, "Peers")


def test_a_stranger_is_not_ours() -> None:
    assert [*map(extras.is_ours, ("visnav-runtime", "visnav_airsim", "visnav_mine", "other"))] == [
        *(True, True, False, False)
    ]
