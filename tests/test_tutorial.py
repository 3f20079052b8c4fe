"""The session of docs/tutorial/thirty-minutes.md is true, typed in order in an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/tutorial/thirty-minutes.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r'^```(\w+)(?: title="([^"\n]*)")?\n(.*?)^```$', PAGE, re.MULTILINE | re.DOTALL)
FIRST = (ROOT / "docs/tutorial/first-flight.md").read_text(encoding="utf-8")
NUMBER = r"-?\d+(?:\.\d+)?"
OF_THIS_MACHINE = rf"in {NUMBER} s \({NUMBER} × real time\)|takes {NUMBER} ms here|\d{{8}}-\d{{6}}"
"""What differs from machine to machine."""

FAILS = "FAILED"
"""Stands in what a page shows of a command that ends with exit code 1."""


def typed(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Type a line into a shell where the project is installed."""
    scripts = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{scripts}:{os.environ['PATH']}", "NO_COLOR": "1"}
    environment |= {"COLUMNS": "120"}
    return subprocess.run(
        line, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def of_any_machine(line: str) -> str:
    """Return a line without what differs between machines, and without a table's rule."""
    return " ".join(re.sub(OF_THIS_MACHINE, "", line.strip(" ─")).split())


def assert_shows(printed: str, shown: str) -> None:
    """Assert that each shown line is printed, in order; numbers may differ by half."""
    rest = iter([text for line in printed.splitlines() if (text := of_any_machine(line))])
    for line in filter(None, map(of_any_machine, shown.splitlines())):
        plain = re.escape(line).replace(r"\.", ".").replace(r"\-", "-")
        pattern = re.sub(NUMBER, lambda _: f"({NUMBER})", plain)
        for output in rest:
            if match := re.fullmatch(pattern, output):
                numbers = [float(number) for number in re.findall(NUMBER, line)]
                printed_numbers = [float(number) for number in match.groups()]
                assert printed_numbers == pytest.approx(numbers, rel=0.5), f"{line}: {output}"
                break
        else:
            raise AssertionError(f"expected {line!r} in:\n{printed}")


def test_what_is_shown_and_not_printed_is_found() -> None:
    printed = "tour: 59.1 s, in 22.8 s (2.6 × real time)\nodometry PASSED\n  ATE 0.0053 m (0.01 %)"
    assert_shows(printed, "tour: 59.1 s, in 7.0 s (9 × real time)\n  ATE 0.006 m (0.01 %)")
    for wrong in ("odometry FAILED", "  ATE 0.053 m (0.01 %)", "odometry PASSED\ntour: 59.1 s,"):
        with pytest.raises(AssertionError):
            assert_shows(printed, wrong)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_strangers_session(tmp_path: Path) -> None:
    """Each file is written and each command run as the page says, and prints what it shows."""
    printed, commands = "", 0
    for index, (language, title, text) in enumerate(BLOCKS):
        follows = BLOCKS[index + 1] if index + 1 < len(BLOCKS) else ("", "", "")
        if title:
            (tmp_path / title).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / title).write_text(text, encoding="utf-8")
        lines = text.splitlines() if language == "sh" else []
        if language == "yaml":
            lines = re.findall(r"run: (visnav .*)", text)
        for line in lines:
            done = typed(line, tmp_path)
            commands += 1
            printed = done.stdout + done.stderr
            fails = follows[0] == "text" and FAILS in follows[2]
            assert done.returncode == fails, f"{line}: {printed}"
            if line == "visnav demo":
                (shown,) = re.findall(r"^```text\n(tour: .*?)^```$", FIRST, re.M | re.S)
                assert_shows(printed, shown)
        if language == "sh" and follows[0] == "text":
            assert_shows(printed, follows[2])
    assert commands >= 6
    assert (tmp_path / "results" / "flight.xml").is_file()
    for path in re.findall(r"`((?:runs|compared)/[\w./-]+)`", PAGE):
        assert (tmp_path / path).exists(), path
