"""Mutation testing: the faults that are planted; those listed as equivalent are among them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tools.mutants import ROOT, equivalents, listed, path_of, places_of
from tools.mutations import mutants

LISTED = listed()
TESTS = LISTED.pop("tests")


@pytest.mark.parametrize(
    ("line", "becomes"),
    [
        ("x = a < b", ["x = (a <= b)", "x = (a >= b)"]),
        ("x = a is not b in c", ["x = (a is b in c)", "x = (a is not b not in c)"]),
        ("x = not a or b", ["x = (not a and b)", "x = (a) or b"]),
        ("-a + 2 * b", ["(-a - 2 * b)", "(a) + 2 * b", "-a + (2 / b)", "-a + 3 * b"]),
        ("x = min(a, True)", ["x = (max(a, True))", "x = min(a, False)"]),
        ("a.any() if b else c", ["a.any() if (not b) else c", "(a.all()) if b else c"]),
        ("x = f('µ', 'left')", ["x = f('', 'left')", "x = f('µ', 'right')"]),
        ("x += 1", ["x -= 1", "pass", "x += 2"]),
        ("return x", ["return None"]),
        ("raise x", ["pass"]),
        ("f()", ["pass"]),
        ("self.x = x", ["pass"]),
        ("if x: f()", ["if (not x): f()", "if x: pass"]),
        ("while x: break", ["while (not x): break", "while x: pass"]),
        ("return None", []),
        ("assert x > 0", []),
        ('x: "A" = y', []),
        ('f"{x + 1}"', []),
        ('"""Text."""', []),
        ('x = "a text for people"', []),
    ],
)  # fmt: skip
def test_each_operator_changes_what_it_says(line: str, becomes: list[str]) -> None:
    planted = [*mutants(f"class A:\n    def f(self):\n        {line}\n".encode())]
    assert [mutant.becomes for mutant in planted] == becomes
    for mutant in planted:
        assert (mutant.function, mutant.lines, mutant.line) == ("A.f", range(3, 4), 3)
        compile(mutant.source, line, "exec")


def test_what_runs_at_import_is_of_all_tests_and_types_are_no_values() -> None:
    source = b"""
T = TypeVar("T")
P = ParamSpec("P")
__all__ = ["f"]
Kind = Literal["a"]
LIMIT = 3
class A:
    limit: int = 4
    def f(self, x: int = 5) -> int: ...
"""
    assert [(m.function, m.becomes, len(m.lines)) for m in mutants(source)] == [
        ("", "LIMIT = 4", 0),
        ("A", "limit: int = 5", 0),
        ("A", "def f(self, x: int = 6) -> int: ...", 0),
    ]


@pytest.mark.parametrize("module", LISTED)
def test_listed_mutants_exist_and_have_a_reason(module: str) -> None:
    there = {mutant[:3] for mutant in mutants((ROOT / path_of(module)).read_bytes())}
    assert not equivalents(module) - there
    assert all(row["why"] for row in LISTED[module])


@pytest.mark.parametrize("module", TESTS)
def test_listed_modules_and_their_further_tests_exist(module: str) -> None:
    assert (ROOT / path_of(module)).is_file()
    assert [place for place in places_of(module) if not (ROOT / place).exists()] == []
    assert set(TESTS[module]) < set(places_of(module))


@pytest.mark.slow
def test_a_module_is_judged_in_a_copy() -> None:
    before = (ROOT / "events" / "frames.py").read_bytes()
    command = [sys.executable, "-m", "tools.mutants", "events.frames", "--sample=3", "--jobs=2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^events\.frames: [123] of 3 killed", done.stdout, re.MULTILINE), done.stdout
    assert (ROOT / "events" / "frames.py").read_bytes() == before
