"""Imports go one way, events <- runtime <- tools | sims | nodes <- bench, and in no circle."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {
    "events": {"events"},
    "runtime": {"events", "runtime"},
    "runtime.tools": {"events", "runtime", "runtime.tools"},
    "sims": {"events", "runtime", "sims"},
    "nodes": {"events", "runtime", "runtime.tools", "nodes"},
    "visnav_airsim": {"events", "runtime", "sims", "visnav_airsim"},
    "visnav_estimators": {"events", "runtime", "runtime.tools", "nodes", "visnav_estimators"},
    "visnav_foxglove": {"events", "runtime", "nodes", "visnav_foxglove"},
    "visnav_machines": {"events", "runtime", "visnav_machines"},
    "visnav_rerun": {"events", "runtime", "nodes", "visnav_rerun"},
    "visnav_mavlink": {"events", "runtime", "nodes", "visnav_mavlink"},
    "bench": {"events", "runtime", "runtime.tools", "sims", "nodes", "bench", "visnav_airsim"},
}
"""Room to rooms; `runtime` is its core, without the tools around it, ``visnav_…`` an extension."""

EXTENSIONS = {path.name: path.parent for path in sorted(ROOT.glob("extensions/*/visnav_*"))}
PACKAGES = ("events", "runtime", "sims", "nodes", "bench", *EXTENSIONS)
PROMISED = (ROOT / "docs" / "reference" / "extension-interface.md").read_text(encoding="utf-8")
BRIDGES = {
    "glfw",
    "OpenGL",
    "zenoh",
    "rerun",
    "evalio",
    "foxglove",
    "mcap",
    "msgpack",
    "pygeomag",
    "pymavlink",
    "pyorbslam3",
    "rosbags",
    "svo_cpp",
    "textual",
    "yaml",
}
PURE = {"asyncio", "socket", "threading"}
"""What no event imports."""


def imported(source: str, package: str = "") -> set[str]:
    """Return what a source imports, also inside functions, for types only, and by relative name."""
    return _imported(ast.parse(source), package)


def _imported(tree: ast.Module, package: str) -> set[str]:
    names: set[str] = set()
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join(parents) + "." if node.level else ""
            names |= {f"{base}{node.module or ''}.{alias.name}".strip(".") for alias in node.names}
    return names


def _statements(tree: ast.AST) -> Iterator[ast.AST]:
    """Walk the statements, wherever they stand: expressions, ten times as many, import nothing."""
    for block in ("body", "orelse", "handlers", "finalbody", "cases"):
        for node in getattr(tree, block, ()):
            yield node
            yield from _statements(node)


def named(source: str) -> set[str]:
    """Return the modules of ours that strings name: ``"nodes.judging.report"``, ``"sims.x:Y"``.

    Such a string is there to be imported later, or by another process; docstrings are not.
    """
    tree = ast.parse(source)
    documentation = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    strings = (
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in documentation
    )
    pattern = re.compile(rf"((?:{'|'.join(PACKAGES)})(?:\.\w+)+)(:\w+)?")
    matches = filter(None, map(pattern.fullmatch, strings))
    return {match[1] for match in matches if module_of(match[1])}


def room(name: str) -> str:
    """Return the room of a module, or the package of one that is not ours.

    ``python -m runtime`` is the door of the command line, which is one of the tools.
    """
    if name == "runtime.__main__" or f"{name}.".startswith("runtime.tools."):
        return "runtime.tools"
    return name.partition(".")[0]


@cache
def module_names() -> dict[str, Path]:
    """Return the path of each module of ours, by its name."""
    paths = {}
    for package in PACKAGES:
        parent = EXTENSIONS.get(package, ROOT)
        for path in sorted((parent / package).rglob("*.py")):
            parts = path.relative_to(parent).with_suffix("").parts
            paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return paths


def module_of(name: str) -> str | None:
    """Return the module of ours that ``module`` or ``module.attribute`` is in."""
    if name in module_names():
        return name
    parent = name.rpartition(".")[0]
    return parent if parent in module_names() else None


@cache
def imports() -> dict[str, set[str]]:
    """Return what each module of ours imports: modules, or attributes of them."""
    names = {}
    for name, path in module_names().items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        names[name] = imported(path.read_text(encoding="utf-8"), package)
    return names


def of_room(where: str) -> Iterator[tuple[str, set[str]]]:
    return ((name, targets) for name, targets in imports().items() if room(name) == where)


def circles(graph: Mapping[str, Iterable[str]]) -> list[set[str]]:
    """Return the groups of modules each of which is reached from each other of its group."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = [start]
        while ahead:
            new = set(graph[ahead.pop()]) - seen
            seen |= new
            ahead += new
        return seen

    reach = {name: reached(name) for name in graph}
    groups: list[set[str]] = []
    for name, targets in reach.items():
        if name in targets and not any(name in group for group in groups):
            groups.append({name} | {other for other in targets if name in reach[other]})
    return groups


@pytest.mark.slow
@pytest.mark.parametrize("where", MAY_IMPORT)
def test_no_arrow_points_up(where: str) -> None:
    others = {*MAY_IMPORT, "tests", "examples"} - MAY_IMPORT[where]
    upwards = {
        name: wrong
        for name, targets in of_room(where)
        if (wrong := set(map(room, targets)) & others)
    }
    assert upwards == {}


@pytest.mark.slow
@pytest.mark.parametrize("where", MAY_IMPORT)
def test_no_string_points_up(where: str) -> None:
    others = MAY_IMPORT.keys() - MAY_IMPORT[where]
    upwards = {
        name: wrong
        for name, _ in of_room(where)
        if (wrong := set(map(room, named(module_names()[name].read_text("utf-8")))) & others)
    }
    assert upwards == {}


def test_no_circle_closes() -> None:
    """Imports for types only count, too; the face of the runtime, which shows all, does not."""
    graph = {
        name: {m for target in targets if (m := module_of(target))} - {name, "runtime"}
        for name, targets in imports().items()
        if name != "runtime"
    }
    assert circles(graph) == []


def folder(module: str) -> str:
    """Return the folder of a module; one at the root of a room of the core stands for itself."""
    alone = module.count(".") == 1 and room(module) not in EXTENSIONS
    if module_names()[module].name == "__init__.py" or alone:
        return module
    return module.rpartition(".")[0]


def test_no_circle_closes_between_folders() -> None:
    """Those of types only count, too; the face of the runtime, which shows all, does not."""
    graph: dict[str, set[str]] = defaultdict(set)
    for name, imported_names in imports().items():
        if name not in {"runtime", "runtime.__main__"}:
            targets = {module_of(target) for target in imported_names} - {None, "runtime"}
            graph[folder(name)] |= {folder(str(target)) for target in targets} - {folder(name)}
    assert circles({name: graph[name] for name in list(graph)}) == []


def test_entry_points_name_modules_of_ours() -> None:
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    groups = whole["project"]["entry-points"]
    modules = [value.partition(":")[0] for group in groups.values() for value in group.values()]
    known = {*module_names(), *whole["tool"]["setuptools"]["py-modules"]}
    assert [name for name in modules if name not in known] == []
    nodes = {value.partition(".")[0] for value in groups["visnav.nodes"].values()}
    assert nodes == {"sims", "nodes"}


def distributions(requirements: Iterable[str]) -> set[str]:
    """Return the names of what is required, but for extras: of ``rosbags>=0.11``, ``rosbags``."""
    return {
        re.split(r"[^\w.-]", line)[0].lower().replace("_", "-")
        for line in requirements
        if "extra ==" not in line
    }


def test_what_the_core_imports_is_required_by_it_or_by_an_extra() -> None:
    """Or by what that requires in turn; those who check types bring what is for types only."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    offered = [line for name in extras.keys() - {"dev", "docs", "peers"} for line in extras[name]]
    required = distributions([*project["dependencies"], *offered])
    for name in set(required):
        required |= distributions(metadata.requires(name) or ())
    core = {"events", "runtime", "runtime.tools", "sims", "nodes"}
    modules = {room(name) for where in core for _, names in of_room(where) for name in names}
    strangers = modules - core - sys.stdlib_module_names - {"typing_extensions"}
    origins = metadata.packages_distributions()
    assert {name for name in strangers if not distributions(origins[name]) & required} == set()


@pytest.mark.parametrize("package", EXTENSIONS)
def test_an_extension_imports_only_what_is_promised(package: str) -> None:
    rows = re.findall(r"^\| `([\w.]+)` \| (.*) \|$", PROMISED, re.MULTILINE)
    promised = {f"{module}.{name}" for module, row in rows for name in re.findall(r"\w+", row)}
    promised |= {module for module, _ in rows}
    used = {name for _, names in of_room(package) for name in names if room(name) in MAY_IMPORT}
    assert {name for name in used if room(name) not in EXTENSIONS} - promised == set()


def test_events_import_nothing_that_waits_or_talks() -> None:
    impure = {name: wrong for name, m in of_room("events") if (wrong := set(map(room, m)) & PURE)}
    assert impure == {}


@pytest.mark.parametrize("where", sorted(MAY_IMPORT.keys() - {"bench"}))
def test_a_bridge_is_imported_in_one_module_of_a_room_only(where: str) -> None:
    """Zenoh carries both a run's own events and ROS's, in a room each. (Each system that the
    benchmarks measure has a module of its own.)"""
    users = defaultdict(set)
    for name, targets in of_room(where):
        for bridge in set(map(room, targets)) & BRIDGES:
            users[bridge].add(name)
    assert {bridge: names for bridge, names in users.items() if len(names) > 1} == {}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import nodes.viewers.window as w", {"nodes"}),
        ("from nodes import window", {"nodes"}),
        ("def f():\n    from sims.cameras import x", {"sims"}),
        ("if TYPE_CHECKING:\n    import sims", {"sims"}),
        ("from . import other", {"runtime"}),
        ("from .cli import run", {"runtime"}),
        ("from .tools.cli import run", {"runtime.tools"}),
        ("text = 'import sims'", set()),
    ],
)
def test_imports_are_found_wherever_they_stand(source: str, expected: set[str]) -> None:
    assert set(map(room, imported(source, "runtime"))) == expected


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("f('nodes.judging.evaluation')", {"nodes.judging.evaluation"}),
        ("f('sims.multirotor:Multirotor')", {"sims.multirotor"}),
        ("f('nodes.nothing_of_ours.at_all')", set()),
        ("f('see nodes.judging.evaluation')", set()),
        ("'''nodes.judging.evaluation'''", set()),
    ],
)
def test_modules_are_found_in_strings(source: str, expected: set[str]) -> None:
    assert named(source) == expected


@pytest.mark.parametrize(
    ("graph", "expected"),
    [
        ({"a": ["b"], "b": ["c"], "c": []}, []),
        ({"a": ["b", "c"], "b": ["c"], "c": []}, []),
        ({"a": ["b"], "b": ["c"], "c": ["b"]}, [{"b", "c"}]),
        (
            {"a": ["b"], "b": ["c"], "c": ["a"], "d": ["e"], "e": ["d"]},
            [{"a", "b", "c"}, {"d", "e"}],
        ),
    ],
)
def test_circles_are_found(graph: dict[str, list[str]], expected: list[set[str]]) -> None:
    assert circles(graph) == expected


def test_every_room_has_modules_to_look_at() -> None:
    assert [where for where in MAY_IMPORT if len(list(of_room(where))) < 2] == []
