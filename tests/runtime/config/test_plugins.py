"""What packages offer by entry points: ours is complete, and others' plug in the same way."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest

from runtime import extras
from runtime.config.reading import is_base
from runtime.errors import CommandError, MissingDependencyError
from runtime.extras import COMMANDS, NODES, OURS, Offer, offers
from runtime.node import Node
from runtime.tools.cli.commands import load
from tests.runtime.tools.samples_cli import command

MODULE = '''
"""A package of somebody else's."""

import typer
from events import Image
from runtime import Input, Node


class Other(Node):
    """Does something else."""

    images = Input(Image)

    async def run(self) -> None:
        async for image in self.images:
            pass


def fly(height: float = 1.0) -> None:
    """Fly to a height."""
    print(f"flying at {height} m")


def run() -> None:
    """Take the place of ours."""
    raise SystemExit(3)
'''
METADATA = "Metadata-Version: 2.1\nName: other-package\nVersion: 1.0\n"
ENTRY_POINTS = """
[visnav.commands]
fly = other_package:fly
run = other_package:run
torn = other_package_lost:fly
odd = other_package:MISSING

[visnav.nodes]
Other = other_package:Other
Lost = other_package:Lost
"""


@pytest.fixture
def clear() -> Iterator[None]:
    offers.cache_clear()
    yield
    offers.cache_clear()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where `python -m runtime` is started, with another package beside it."""
    (tmp_path / "other_package.py").write_text(MODULE)
    about = tmp_path / "other_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(METADATA)
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    return tmp_path


def node_classes() -> set[type[Node[Any]]]:
    """Return all classes of `sims` and `nodes` that a file may name."""
    classes = set()
    for room in ("sims", "nodes"):
        package = importlib.import_module(room)
        for info in pkgutil.walk_packages(package.__path__, f"{room}."):
            try:
                module = importlib.import_module(info.name)
            except (ImportError, MissingDependencyError):  # an extra that is not installed
                continue
            classes |= {
                value
                for value in vars(module).values()
                if isinstance(value, type)
                and issubclass(value, Node)
                and not is_base(value)
                and not value.__name__.startswith("_")
                and value.__module__ == info.name
            }
    return classes


def test_every_node_is_an_entry_point() -> None:
    ours = [offer for offer in offers(NODES) if offer.package == OURS]
    loaded = {offer.name: offer.load() for offer in ours}
    assert len(loaded) == len(ours)
    assert set(loaded.values()) == node_classes()
    assert [name for name, cls in loaded.items() if cls.__name__ != name] == []


def test_every_command_is_one() -> None:
    ours = [offer for offer in offers(COMMANDS) if offer.package == OURS]
    assert {"run", "check", "nodes", "report", "suite"} <= {offer.name for offer in ours}
    assert [offer.name for offer in ours if not load(offer).help] == []


@pytest.mark.slow
def test_commands_of_another_package_plug_in_and_broken_ones_are_a_line(folder: Path) -> None:
    done = command("--help", folder=folder)
    assert done.returncode == 0
    assert done.stderr == (
        f"warning: the packages {OURS} and other-package both offer the command run; "
        f"that of {OURS} is used\n"
    )
    listing = {line.split()[1]: line for line in done.stdout.splitlines() if len(line.split()) > 2}
    assert "Commands of other-package" in done.stdout
    assert "Fly to a height." in listing["fly"]
    assert "cannot be used: torn of the package other-package" in listing["torn"]
    assert "until they, its duration or Ctrl-C end the run" in listing["run"]
    done = command("fly", "--height", "2", folder=folder)
    assert (done.returncode, done.stdout) == (0, "flying at 2.0 m\n")
    for name in ("torn", "odd"):
        done = command(name, folder=folder)
        assert (done.returncode, done.stdout) == (2, "")
        line = done.stderr.splitlines()[-1]
        assert line.startswith(f"error: {name} of the package other-package: expected 'other_")


@pytest.mark.slow
def test_nodes_of_another_package_are_listed_and_broken_ones_are_a_line(folder: Path) -> None:
    done = command("nodes", "other_package", folder=folder)
    assert done.returncode == 0
    assert done.stdout.startswith("Other\n")
    assert done.stderr.startswith("warning: a node of the package other-package: other_package:Los")
    assert done.stderr.count("\n") == 1


@pytest.mark.usefixtures("clear")
def test_an_installed_package_is_found_by_its_metadata(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Distribution:
        name = OURS

    point = EntryPoint("run", "runtime.tools.cli.run:run", COMMANDS)
    vars(point).update(dist=Distribution)
    monkeypatch.setattr(extras, "_PROJECT", tmp_path / "pyproject.toml")
    monkeypatch.setattr(extras, "_installed", lambda: EntryPoints([point]))
    assert offers(COMMANDS) == (Offer(OURS, "run", "runtime.tools.cli.run:run"),)


@pytest.mark.usefixtures("clear")
def test_a_project_of_somebody_else_around_ours_is_not_taken_for_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'theirs'\n")
    monkeypatch.setattr(extras, "_PROJECT", tmp_path / "pyproject.toml")
    monkeypatch.setattr(extras, "_installed", lambda: EntryPoints())
    with pytest.raises(CommandError, match=r"expected the package visnav-runtime to be installed"):
        offers(COMMANDS)
