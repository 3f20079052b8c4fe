"""Whatever a node raises, wherever it does: the run ends as documented, and keeps what there was.

Node faults × clocks × on_error, each a run of the command line's. The rules are in
``docs/explanation/what-happens-when.md``.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from runtime.tools.cli import main
from tests.runtime.samples_faults import PLACES, WAYS
from tests.runtime.tools.samples_cli import ROOT, results
from tests.runtime.tools.samples_cli import summary as summary_of

COMBINATIONS = list(itertools.product(("lockstep", "real"), ("stop", "restart", "drop")))
COROUTINES = {"on_startup", "on_ready", "run", "started", "task_group", "on_shutdown"}
EARLY = {"on_startup", "announce", "on_announcement", "check", "on_ready"}
QUICK = [
    ("run", "SystemExit", "lockstep", "stop"),
    ("handler", "BaseException", "real", "drop"),
    ("on_ready", "CancelledError", "lockstep", "restart"),
]

SAID = {
    "RuntimeError": "RuntimeError: out of order",
    "ExceptionGroup": "2 errors: KeyError: 'a'; ValueError: b",
    "SystemExit": "SystemExit: 3 (expected self.stop(reason), which ends a run)",
    "KeyboardInterrupt": "KeyboardInterrupt: (expected self.stop(reason), which ends a run)",
    "CancelledError": "CancelledError:",
    "GeneratorExit": "GeneratorExit:",
    "StopIteration": "StopIteration:",
    "BaseException": "BaseException: of the very base",
}


def run_batch(folder: Path, modes: list[tuple[str, str, str, str]]) -> None:
    """Do all runs in one process, one after the other; called in a process of its own."""
    for number, (place, way, clock, rule) in enumerate(modes):
        here = folder / f"{number}"
        here.mkdir()
        duration = 3.0 if rule == "stop" else 0.5  # those end sooner, if the machine is idle
        (here / "a.toml").write_text(
            f"[run]\nname = 'a'\nclock = '{clock}'\nduration = {duration}\n"
            "shutdown_limit = 2\nstall = 0\n"
            "[[nodes]]\nname = 'first'\ntype = 'tests.runtime.samples_faults:Witness'\n"
            f"[[nodes]]\nname = 'faulty'\ntype = 'tests.runtime.samples_faults:Faulty'\n"
            f"place = '{place}'\nway = '{way}'\non_error = '{rule}'\n"
            "[[nodes]]\nname = 'last'\ntype = 'tests.runtime.samples_faults:Witness'\n",
            encoding="utf-8",
        )
        out, err, code = io.StringIO(), io.StringIO(), 0
        with (
            mock.patch.object(sys, "argv", ["runtime", "run", "a.toml", "--quiet"]),
            contextlib.chdir(here),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            try:
                main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 99
        told = {"code": code, "err": err.getvalue(), "out": out.getvalue()}
        (here / "told.json").write_text(json.dumps(told), encoding="utf-8")


def wrong_with(here: Path, place: str, way: str, rule: str) -> list[str]:
    """Return all that is not as documented about a run."""
    told = json.loads((here / "told.json").read_text(encoding="utf-8"))
    lines = told["err"].splitlines()
    last = lines[-1] if lines else ""
    fails = place in EARLY | {"on_shutdown", "after_run"} or rule == "stop"
    if (place, way) == ("task_group", "CancelledError"):
        fails = False  # asyncio's own rule: a cancelled child is no error of its group
    text = SAID[way]
    if way == "StopIteration" and place in COROUTINES:
        text = "RuntimeError: coroutine raised StopIteration"
    reason = "duration"
    if place in EARLY:
        reason = "start-up failed"
    elif fails and place not in {"on_shutdown", "after_run"}:
        reason = "faulty failed"
    wrong = []

    def expect(what: str, given: Any, wanted: Any) -> None:
        if given != wanted:
            wrong.append(f"{what}: {given!r}, not {wanted!r}")

    expect("exit code", told["code"], 2 if fails else 0)
    if fails:
        expect("last line", last[: len(text) + 15], f"error: faulty: {text}")
    expect("traceback", "Traceback" in told["err"], False)
    try:
        summary = summary_of(out := results(here))
    except (OSError, ValueError) as error:
        return [*wrong, str(error), told["err"]]
    expect(
        "named in the summary", "faulty" in (summary["error"] or ""), fails and place != "after_run"
    )
    expect("reason", summary["reason"], reason)
    names = ["first"] if place == "on_startup" else ["first", "last"]
    for name in names:
        count = int((out / f"{name}.txt").read_text(encoding="utf-8"))
        expect(f"{name} kept", count > 0, place not in EARLY)
        expect(f"{name} called", (out / f"{name}.after").exists(), True)
    return wrong


def check(folder: Path, modes: list[tuple[str, str, str, str]]) -> None:
    """Do the runs in a process, and compare what came of them."""
    code = (
        "import sys, json; from pathlib import Path; "
        "from tests.runtime.run.test_node_faults import run_batch; "
        "run_batch(Path(sys.argv[1]), json.loads(sys.argv[2]))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder), json.dumps(modes)],
        env=environment,
        timeout=15 * len(modes) + 30,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    wrong = {
        (place, way, clock, rule): faults
        for number, (place, way, clock, rule) in enumerate(modes)
        if (faults := wrong_with(folder / f"{number}", place, way, rule))
    }
    assert wrong == {}


@pytest.mark.slow
def test_a_run_survives_what_a_node_raises(tmp_path: Path) -> None:
    check(tmp_path, QUICK)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", range(len(COMBINATIONS)), ids=map("-".join, COMBINATIONS))
def test_a_run_survives_whatever_a_node_raises(number: int, tmp_path: Path) -> None:
    """13 places × 8 ways, with each clock and rule a quarter of them; any four have them all."""
    modes = [
        (place, way, *COMBINATIONS[number])
        for row, place in enumerate(PLACES)
        for column, way in enumerate(WAYS)
        if (row + column + number) % 4 == 0
    ]
    check(tmp_path, modes)


def test_the_page_of_what_happens_when_names_tests_and_messages_that_there_are() -> None:
    """Each row names a file of tests, and quotes messages as the runtime has them."""
    page = (ROOT / "docs" / "explanation" / "what-happens-when.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1:-1] for line in page.splitlines() if line.startswith("| ")][1:]
    assert len(rows) >= 18
    sources = "".join(
        path.read_text(encoding="utf-8")
        for folder in (ROOT / "runtime", ROOT / "extensions" / "machines")
        for path in sorted(folder.rglob("*.py"))
    )
    for row in rows:
        assert len(row) == 5, row
        tests = row[4].strip().strip("`")
        assert any(
            path for room in ("tests", "extensions") for path in (ROOT / room).rglob(tests)
        ), row
        assert row[3].strip() in {"0", "1", "2", "130", "137", "signal", "as else", ""}, row
        for quoted in re.findall(r"expected [a-z' ]+", row[2]):
            assert quoted.removeprefix("expected ").split(" to end")[0].strip() in sources, quoted
