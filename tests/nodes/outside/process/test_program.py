"""Programs beside a run: none goes unnoticed, none is left behind, none floods the log."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.outside.process.program import Program
from runtime.workers.output import LINES, Output, Throttle, how_it_ended, plain_lines

pytestmark = pytest.mark.timeout(60)

FORKS = """
import os, signal, sys, time
if os.fork() == 0:
    os.setsid()                      # a daemon: in no group of ours, and nobody's child
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        print(os.getpid(), flush=True)
        time.sleep(600)
    os._exit(0)
time.sleep(float(sys.argv[1]))
"""
STUBBORN = """
import signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("deaf", flush=True)
time.sleep(600)
"""
POLITE = """
import signal, sys, time
def end(*_):
    print("goodbye", flush=True)
    sys.exit(5)
signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
time.sleep(600)
"""


class Started:
    """A program, and what was heard of it."""

    def __init__(self, *command: str, grace: float = 0.3) -> None:
        self.lines: list[str] = []
        self.told: list[str] = []
        self.ended = threading.Event()
        self.program = Program(
            command,
            Path.cwd(),
            os.environ,
            grace=grace,
            printed=self.lines.append,
            ended=self._note,
        )

    def _note(self, story: str) -> None:
        self.told.append(story)
        self.ended.set()

    def wait_for_line(self) -> str:
        until = time.monotonic() + 30
        while not self.lines:
            assert time.monotonic() < until
            time.sleep(0.01)  # until the process has printed: there is no other sign
        return self.lines[0]


@pytest.fixture
def start() -> Iterator[type[Started]]:
    made: list[Started] = []

    class Kept(Started):
        def __init__(self, *command: str, grace: float = 0.3) -> None:
            super().__init__(*command, grace=grace)
            made.append(self)

    yield Kept
    for program in made:
        program.program.close()


def python(code: str, *words: str) -> tuple[str, ...]:
    return sys.executable, "-c", code, *words


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone_soon(pid: int) -> bool:
    until = time.monotonic() + 20
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.01)  # until the kernel and a guard have ended it
    return not alive(pid)


@pytest.mark.parametrize(
    ("command", "story", "code"),
    [
        (python("print('no map'); exit(3)"), "ended with exit code 3; its last output:\nno map", 3),
        (python("pass"), "ended with exit code 0; it said nothing", 0),
        (
            python("import os; os.abort()"),
            "killed by signal 6 (Aborted); it said nothing",
            -signal.SIGABRT,
        ),
        (
            python("import sys; print('a'); print('b', file=sys.stderr); print('c', end='')"),
            "ended with exit code 0; its last output:\n",
            0,
        ),
        (("./not_there",), "cannot be started: No such file or directory; it said nothing", None),
    ],
)
def test_its_end_is_told_with_its_exit_code_and_last_lines(
    command: tuple[str, ...], story: str, code: int | None, start: type[Started]
) -> None:
    it = start(*command)
    assert it.program.wait(30)
    assert it.program.story().startswith(story)
    assert it.program.code == code
    it.program.close()
    assert len(it.told) == 1
    assert it.told[0].startswith(story)


def test_it_is_told_at_once_even_if_a_child_keeps_its_output_open(start: type[Started]) -> None:
    it = start(*python(FORKS, "0.2"), grace=20.0)
    daemon = int(it.wait_for_line())
    assert it.ended.wait(10)  # and not only after the grace of the child
    assert alive(daemon)
    assert it.told[0].startswith("ended with exit code 0; its last output:")
    os.kill(daemon, signal.SIGKILL)


def test_with_it_end_those_that_it_has_started_wherever_they_went(start: type[Started]) -> None:
    it = start(*python(FORKS, "600"))
    daemon = int(it.wait_for_line())
    assert alive(daemon)
    it.program.close()
    assert not alive(daemon)
    assert not it.told  # it was we who ended it


@pytest.mark.parametrize(
    ("code", "first", "result"),
    [(STUBBORN, "deaf", -signal.SIGKILL), (POLITE, "ready", 5)],
)
def test_it_gets_a_grace_and_not_more(
    code: str, first: str, result: int, start: type[Started]
) -> None:
    it = start(*python(code), grace=0.3 if first == "deaf" else 30.0)
    assert it.wait_for_line() == first
    it.program.close()
    assert it.program.code == result
    assert (it.lines[-1] == "goodbye") == (first == "ready")


def test_a_guard_that_is_killed_takes_the_program_along(start: type[Started]) -> None:
    it = start(*python("import os, time; print(os.getpid(), flush=True); time.sleep(600)"))
    pid = int(it.wait_for_line())
    it.program._guard.kill()
    assert it.ended.wait(10)
    assert it.told[0].startswith("killed; its last output:")
    assert gone_soon(pid)


RUN = """
import os, sys, time
from pathlib import Path
from nodes.outside.process.program import Program
code = sys.argv[1]
Program([sys.executable, "-c", code, "600"], Path.cwd(), os.environ, grace=0.3,
        printed=lambda line: print(line, flush=True))
time.sleep(600)
"""


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_nothing_behind() -> None:
    with subprocess.Popen([sys.executable, "-c", RUN, FORKS], stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        daemon = int(run.stdout.readline())
        assert alive(daemon)
        run.kill()
    assert gone_soon(daemon)


def test_a_flood_is_counted_but_not_logged() -> None:
    lines: list[str] = []
    seconds = iter([*[5.0] * 150, *[6.9] * 20, *[7.0] * 101])
    limited = Throttle(lines.append, lambda: next(seconds))
    for _ in range(271):
        limited("x")
    limited.end()
    limited.end()
    assert lines == ["x"] * LINES + ["(50 more lines)"] + ["x"] * (20 + LINES) + ["(1 more lines)"]


@pytest.mark.slow
def test_all_of_a_flood_is_read(start: type[Started]) -> None:
    it = start(*python("import os\nfor n in range(200): os.write(1, b'x' * 99 + b'\\n' * 1000)"))
    it.program.wait()
    it.program.close()
    assert len(it.lines) == 200_000


def test_lines_come_when_they_are_printed(start: type[Started]) -> None:
    """A library's output is not kept back in blocks: it is a terminal that it is printed to."""
    it = start(*python("import sys, time\nprint('init', sys.stdout.isatty())\ntime.sleep(600)"))
    assert it.wait_for_line() == "init True"


@pytest.mark.parametrize(
    ("printed", "lines"),
    [
        (b"\x1b[1;32mready\x1b[0m\n", ["ready"]),
        (b"\x1b]0;title\x07a\x1b[2J\x1b[H\x07b\x00\n", ["ab"]),
        (b"1 %\r2 %\r100 %\r\ndone\r\n", ["1 %", "2 %", "100 %", "done"]),
        ("gr\u00fc\u00dfe\x85\u2028wide \u98db\n".encode(), ["gr\u00fc\u00dfe wide \u98db"]),
        (b"\xff\x9b31m\n", ["\ufffd\ufffd31m"]),
        (b"x" * 5000 + b"\n", ["x" * 4096, "x" * 904]),
    ],
)
def test_what_controls_a_terminal_is_left_out(printed: bytes, lines: list[str]) -> None:
    logged: list[str] = []
    output = Output(logged.append)
    for byte in printed:
        output.add(bytes([byte]))
    output.end()
    assert logged == lines
    assert [*plain_lines(printed.removesuffix(b"\n"))] == lines


@given(st.lists(st.binary(max_size=3000), max_size=20))
def test_lines_are_the_same_however_they_arrive(pieces: list[bytes]) -> None:
    def lines(pieces: list[bytes]) -> list[str]:
        logged: list[str] = []
        output = Output(logged.append)
        for piece in pieces:
            output.add(piece)
        output.end()
        return logged

    assert lines(pieces) == lines([b"".join(pieces)])


@given(st.lists(st.text(st.characters(codec="ascii", exclude_categories=["C"]))))
def test_what_controls_no_terminal_is_told_as_it_is(lines: list[str]) -> None:
    logged: list[str] = []
    output = Output(logged.append)
    output.add("".join(f"{line}\n" for line in lines).encode())
    assert logged == [line.rstrip() for line in lines]


@pytest.mark.slow
def test_a_line_without_end_takes_no_more_memory_than_a_long_one() -> None:
    logged: list[str] = []
    output = Output(logged.append)
    for _ in range(1000):
        output.add(b"x" * 65536)
    assert len(output._begun) <= 4096
    assert {len(line) for line in logged} == {4096}


def test_an_unknown_signal_is_told_by_its_number() -> None:
    assert how_it_ended(-33).startswith("killed by signal 33 (")
