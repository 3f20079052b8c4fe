"""A library that is missing is one line of `check`, with what installs it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.runs.test_check import check, room

__all__ = ["room"]  # a fixture

LACKING = [
    ("Svo", "svo_cpp", "make svo, or: pip install --no-deps 'svo-cpp>=1.5'"),
    (
        "OrbSlam3",
        "pyorbslam3",
        "make orbslam3, or: pip install './extensions",
    ),
]


@pytest.mark.parametrize(("type_", "library", "install"), LACKING)
def test_a_missing_library_is_one_line_with_what_installs_all(
    type_: str, library: str, install: str, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    code, lines = check(room, f"odometry.type={type_}")
    assert (code, len(lines)) == (2, 1)
    assert f"needs {library} (No module named '{library}'): {install}" in lines[0]
