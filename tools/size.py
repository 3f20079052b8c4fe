"""What a maintainer must hold: lines, what an import brings, and files per kind of change.

A line of code is one that is neither blank nor a comment nor part of a docstring.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
CORE = ("events", "runtime", "sims", "nodes", "visnav.py", "visnav_pytest.py")
CLOSURES = ("runtime.node", "runtime.run.execute")


class Change(NamedTuple):
    """Kind of change, measured by something that is there: whatever names it was touched for it."""

    instance: str
    names: str  # regular expression of its names in code
    limit: int  # of files
    within: tuple[str, ...] = ("events", "runtime", "sims", "nodes", "pyproject.toml")
    without: tuple[str, ...] = ()  # what names it for another reason
    beside: tuple[str, ...] = ()  # its test and its page, which count


CHANGES = {
    "sensor": Change(
        "magnetometer",
        r"Magnetometer|MagneticField\b",
        6,
        without=(
            "nodes/ros2",  # a mapping, which has a row of its own here
            "nodes/outside/native/visnav_link.hpp",  # version 2 of the protocol has its rows
        ),
        beside=("tests/sims/sensors/test_earth.py", "docs/how-to/sensors.md"),
    ),
    "ROS mapping": Change("sensor_msgs/MagneticField", r"\bmagnetic_field\b", 3, ("nodes/ros2",)),
    "reader": Change("KITTI", r"\bKitti\b", 1),
    "figure": Change("heading_rmse_deg", r"\bheading_rmse_deg\b", 2),
    "command": Change("recover", r"recover:recover|def recover\(", 2),
}
"""The kinds of change that CONTRIBUTING.md describes."""


def files_of(change: Change) -> list[str]:
    """Return the files that a change of a kind touches: those that name its instance."""
    files = []
    for name in _tracked(*change.within):
        if name.startswith(change.without) or not name.endswith((".py", ".hpp", ".toml")):
            continue
        if re.search(change.names, (ROOT / name).read_text(encoding="utf-8")):
            files.append(name)
    return [*files, *change.beside]


def _tracked(*patterns: str) -> list[str]:
    command = ["git", "ls-files", "--", *patterns]
    return subprocess.check_output(command, cwd=ROOT, text=True).split()  # noqa: S603


class Size(NamedTuple):
    """Lines of files."""

    files: int = 0
    lines: int = 0
    code: int = 0

    def __add__(self, other: tuple[int, ...]) -> Size:  # type: ignore[override]
        return Size(*(a + b for a, b in zip(self, other, strict=True)))


def room(name: str) -> str:
    """Return what a file belongs to: a room, an extension, or the tests of either."""
    first, *rest = name.split("/")
    if first != "extensions" or len(rest) < 2:
        return first
    return f"extensions/{rest[0]}" + ("/tests" if rest[1] == "tests" else "")


def code_lines(text: str) -> int:
    """Return the number of lines of code of a Python source."""
    documented = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node.value.value, str) and node.end_lineno
        for line in range(node.lineno, node.end_lineno + 1)
    }
    nothing = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    coded = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in nothing | {tokenize.ENDMARKER}
        for line in range(token.start[0], token.end[0] + 1)
    }
    return len(coded - documented)


def sizes() -> dict[str, Size]:
    """Return the sizes of all rooms: Python, and beside it C++ as ``room (C++)``."""
    total: dict[str, Size] = defaultdict(Size)
    for name in _tracked("*.py", "*.cpp", "*.hpp"):
        text = (ROOT / name).read_text(encoding="utf-8")
        lines = len(text.splitlines())
        if name.endswith(".py"):
            total[room(name)] += (1, lines, code_lines(text))
        else:
            stated = [line.strip() for line in text.splitlines()]
            total[f"{room(name)} (C++)"] += (1, lines, sum(map(is_cpp_code, stated)))
    return dict(sorted(total.items()))


def is_cpp_code(line: str) -> bool:
    """Return whether a stripped line of C++ is code."""
    return bool(line) and not line.startswith(("//", "/*", "*"))


def core(total: dict[str, Size]) -> Size:
    """Return the size of the core, Python and C++."""
    sizes = [size for name, size in total.items() if name.removesuffix(" (C++)") in CORE]
    return sum(sizes, Size())


def closure(module: str) -> Size:
    """Return the size of all of `events` and `runtime` that is loaded with a module."""
    code = (
        f"import sys, {module}\n"
        "for name, module in list(sys.modules.items()):\n"
        "    if name.partition('.')[0] in ('events', 'runtime'): print(module.__file__)"
    )
    command = [sys.executable, "-c", code]
    names = subprocess.check_output(command, cwd=ROOT, text=True).split()  # noqa: S603
    texts = [Path(name).read_text(encoding="utf-8") for name in names]
    return Size(len(texts), sum(len(t.splitlines()) for t in texts), sum(map(code_lines, texts)))


def main() -> None:
    """Print a row for each room, the core, what an import brings, and each kind of change."""
    total = sizes()
    print(f"{'':30} {'files':>6} {'lines':>8} {'code':>8}")
    rows = [*total.items(), ("", None), ("core, Python and C++", core(total))]
    rows += [(f"loaded with {module}", closure(module)) for module in CLOSURES]
    for name, size in rows:
        print(f"{name:30} {size.files:6,} {size.lines:8,} {size.code:8,}" if size else "")
    print(f"\n{'files to touch for a new':30} {'files':>6} {'limit':>8}")
    for kind, change in CHANGES.items():
        touched = f"as {change.instance}: {', '.join(files_of(change))}"
        print(f"{kind:30} {len(files_of(change)):6} {change.limit:8}   {touched}")


if __name__ == "__main__":
    main()
