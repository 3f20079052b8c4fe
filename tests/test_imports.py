"""Imports go one way: events <- runtime <- sims | nodes <- bench, and bridges stay in one place."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {
    "events": {"events"},
    "runtime": {"events", "runtime"},
    "sims": {"events", "runtime", "sims"},
    "nodes": {"events", "runtime", "nodes"},
    "bench": {"events", "runtime", "sims", "nodes", "bench"},
}
BRIDGES = {
    "glfw",
    "OpenGL",
    "zenoh",
    "rerun",
    "foxglove",
    "mcap",
    "pyorbslam3",
    "rosbags",
    "textual",
}
PURE = {"asyncio", "socket", "threading"}
"""What no event imports."""


def imported(source: str, package: str = "") -> set[str]:
    """Return the modules that a source imports, also inside functions and by relative name."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join(parents) + "." if node.level else ""
            found.add(f"{base}{node.module or ''}".strip("."))
            found |= {f"{base}{node.module or ''}.{alias.name}".strip(".") for alias in node.names}
    return found


def rooms_of(modules: set[str]) -> set[str]:
    return {module.partition(".")[0] for module in modules}


@cache
def sources(room: str) -> list[tuple[str, set[str]]]:
    """Return each module of a room, by path, and what it imports."""
    found = []
    for path in sorted((ROOT / room).rglob("*.py")):
        name = path.relative_to(ROOT)
        package = ".".join(name.parent.parts)
        found.append((str(name), imported(path.read_text(encoding="utf-8"), package)))
    return found


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_no_arrow_points_up(room: str) -> None:
    upwards = {
        name: wrong
        for name, modules in sources(room)
        if (wrong := rooms_of(modules) & {*MAY_IMPORT, "tests", "examples"} - MAY_IMPORT[room])
    }
    assert upwards == {}


def test_events_import_nothing_that_waits_or_talks() -> None:
    assert {name: found for name, m in sources("events") if (found := rooms_of(m) & PURE)} == {}


@pytest.mark.parametrize("room", sorted(MAY_IMPORT.keys() - {"bench"}))
def test_a_bridge_is_imported_in_one_module_of_a_room_only(room: str) -> None:
    """A room for two: Zenoh carries both a run's own events and ROS's. (A benchmark's peers each
    import what they measure.)"""
    where = defaultdict(set)
    for name, modules in sources(room):
        for bridge in rooms_of(modules) & BRIDGES:
            where[bridge].add(name)
    assert {bridge: names for bridge, names in where.items() if len(names) > 1} == {}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import nodes.window as w", {"nodes"}),
        ("from nodes import window", {"nodes"}),
        ("def f():\n    from sims.cameras import x", {"sims"}),
        ("if TYPE_CHECKING:\n    import sims", {"sims"}),
        ("from . import other", {"runtime"}),
        ("from .cli import run", {"runtime"}),
        ("text = 'import sims'", set()),
    ],
)
def test_imports_are_found_wherever_they_stand(source: str, found: set[str]) -> None:
    assert rooms_of(imported(source, "runtime")) == found


def test_every_room_has_modules_to_look_at() -> None:
    assert [room for room in MAY_IMPORT if len(sources(room)) < 2] == []
