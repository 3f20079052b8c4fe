"""Nodes that do not end: the run goes on without them, names them, and says what it waits for.

Each is a run in a process of its own, because some of it can only be left behind.
"""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path

import pytest

from tests.runtime.tools.samples_cli import results, start, summary

pytestmark = pytest.mark.timeout(180)
CLOCKS = ["lockstep", "real"]
HERE = r"runtime/samples_faults\.py:\d+ in "
LONGEST = 30.0
"""Seconds from when a run should end to when it has, limits and a busy machine included."""

FILE = """[run]
name = 'a'
clock = '{clock}'
duration = {duration}
startup_limit = 0.3
shutdown_limit = 0.3
progress_limit = 0.6
stall = 0
[[nodes]]
name = 'first'
type = 'tests.runtime.samples_faults:Witness'
[[nodes]]
name = 'bad'
type = 'tests.runtime.samples_faults:Stubborn'
place = '{place}'
way = '{way}'
"""


class Ended:
    def __init__(self, folder: Path, place: str, way: str, clock: str, number: int = 0) -> None:
        """Run it to its end, sent a signal once it runs, if one is given."""
        file = folder / "a.toml"
        duration = 0 if number else 0.5
        text = FILE.format(place=place, way=way, clock=clock, duration=duration)
        file.write_text(text, encoding="utf-8")
        with start(["run", file, "--quiet"], folder) as process:
            if number:
                assert process.stdout is not None
                assert process.stdout.readline() == "running\n"
                time.sleep(1.0)  # of real time: for the watchdog to find that nothing goes on
                process.send_signal(number)
            begin = time.monotonic()
            try:
                _, self.err = process.communicate(timeout=60)
            finally:
                process.kill()
            self.code = process.returncode
            self.seconds = time.monotonic() - begin
        self.lines = self.err.splitlines()
        self.last = self.lines[-1] if self.lines else ""
        out = results(folder)
        self.summary = summary(out)
        assert (out / "first.after").exists()
        assert "Traceback" not in self.err


MODES = [
    ("on_startup", "swallow", r"on_startup to end within 0\.3 s", "swallow"),
    ("on_startup", "spin", r"on_startup to end within 0\.3 s", "spin"),
    ("on_startup", "block", "it to give back the loop", "block"),
    ("on_startup", "sleep", "it to give back the loop", "sleep"),
    ("on_ready", "swallow", r"on_ready to end within 0\.3 s", "swallow"),
    ("on_ready", "block", "it to give back the loop", "block"),
    ("run", "swallow", r"its tasks to end within [\d.]+ s", "swallow"),
    ("run", "spin", r"its tasks to end within [\d.]+ s", "spin"),
    ("on_shutdown", "swallow", r"on_shutdown to end within [\d.]+ s", "swallow"),
    ("on_shutdown", "spin", r"on_shutdown to end within [\d.]+ s", "spin"),
    ("on_shutdown", "block", "it to give back the loop", "block"),
    ("on_shutdown", "wait_for_thread", r"on_shutdown to end within [\d.]+ s", "wait_for_thread"),
    ("started late", "swallow", r"its tasks to end within [\d.]+ s", "swallow"),
]
QUICK = {("run", "swallow"), ("on_shutdown", "block")}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize(
    ("place", "way", "what", "function"),
    [
        pytest.param(*m, marks=() if m[:2] in QUICK else pytest.mark.slow, id=f"{m[0]} {m[1]}")
        for m in MODES
    ],
)
def test_what_does_not_end_is_named_and_left_behind(
    place: str, way: str, what: str, function: str, clock: str, tmp_path: Path
) -> None:
    if (place, way, clock) == ("run", "spin", "lockstep"):
        pytest.skip("no time passes; see below")
    ended = Ended(tmp_path, place, way, clock)
    assert ended.code == 2
    assert re.match(
        rf"error: bad: expected {what}.*, found .* \({HERE}{function}\)$", ended.last
    ), ended.err
    assert "bad: expected" in ended.summary["error"]
    assert ended.seconds < LONGEST


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "clock", "named", "code"),
    [
        ("block", "lockstep", rf"the loop has not turned for .*: bad, at {HERE}block", 2),
        ("block", "real", rf"the loop has not turned for .*: bad, at {HERE}block", 2),
        ("sleep", "real", rf"the loop has not turned for .*: bad, at {HERE}sleep", 2),
        ("spin", "lockstep", rf"no time has passed .* again and again: .*bad.*, at {HERE}", 2),
        ("wait_for_thread", "lockstep", rf"waited for bad: slow work, at {HERE}wait_for_thr", 0),
    ],
)
def test_what_stands_still_is_named_and_ctrl_c_ends_it(
    way: str, clock: str, named: str, code: int, tmp_path: Path
) -> None:
    ended = Ended(tmp_path, "run", way, clock, signal.SIGINT)
    assert re.search(named, ended.err), ended.err
    assert ended.summary["reason"] == "Ctrl-C"
    assert ended.code == code, ended.err
    assert ended.seconds < LONGEST


@pytest.mark.slow
@pytest.mark.parametrize("clock", CLOCKS)
def test_eight_stuck_threads_share_one_limit(clock: str, tmp_path: Path) -> None:
    ended = Ended(tmp_path, "run", "threads", clock, signal.SIGTERM)
    assert ended.code == 0
    assert ended.last.startswith("warning: still busy, left behind: offload_0, offload_1")
    assert ended.seconds < 8  # one each is eight


@pytest.mark.slow
def test_a_start_that_hangs_is_named_while_it_does(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(
        FILE.format(place="on_startup", way="wait_for_thread", clock="real", duration=1).replace(
            "startup_limit = 0.3", "startup_limit = 2"
        ),
        encoding="utf-8",
    )
    with start(["run", tmp_path / "a.toml", "--quiet"], tmp_path) as process:
        _, err = process.communicate(timeout=60)
    assert re.search(rf"the run has waited for bad: on_startup, at {HERE}wait_for_thread", err)
    assert process.returncode == 2
