"""What a change touches, and what an import brings, stays as little as CONTRIBUTING.md says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.size import CHANGES, closure, files_of

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("kind", CHANGES)
def test_a_change_touches_few_files(kind: str) -> None:
    change = CHANGES[kind]
    files = files_of(change)
    assert 0 < len(files) <= change.limit, files
    assert all(re.search(change.names, (ROOT / name).read_text("utf-8")) for name in files)


def test_the_page_for_contributors_has_each_kind_with_its_files() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for kind, change in CHANGES.items():
        (row,) = re.findall(rf"^\| {kind} \|.*$", page, re.MULTILINE)
        assert f"| {change.limit} |" in row


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "limit"), [("runtime.node", 7_000), ("runtime.run.execute", 11_000)]
)
def test_an_import_brings_few_lines(module: str, limit: int) -> None:
    assert 1_000 < closure(module).lines <= limit
