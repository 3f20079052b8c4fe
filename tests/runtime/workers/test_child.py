"""The main program of a worker's process, run in a thread here: what it answers, and its limits."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest

from runtime.workers import child
from runtime.workers.output import PortableError
from runtime.workers.shared_memory import SharedPipe, anonymous_file

pytestmark = pytest.mark.timeout(20)
LIMIT = 60.0


class Machine:
    """What a process does to itself, noted in its order instead of done."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[Any] = []
        monkeypatch.setattr(signal, "signal", self.note("signal"))
        monkeypatch.setattr(signal, "setitimer", self.note("limit"))
        monkeypatch.setattr(os, "nice", self.note("nice"))
        monkeypatch.setattr(os, "sched_setscheduler", self.note("scheduler"))
        monkeypatch.setattr(os, "sched_setaffinity", self.note("cores"))
        monkeypatch.setattr(os, "cpu_count", lambda: 4)
        monkeypatch.setattr(child, "_end_with_the_run", lambda _: None)
        monkeypatch.setattr(child, "_print_lines", lambda: None)
        monkeypatch.setattr(child, "SharedPipe", self._pipe)
        self.pipes: list[SharedPipe] = []  # which the end of a process would close

    def _pipe(self, *args: Any) -> SharedPipe:
        self.pipes.append(SharedPipe(*args))
        return self.pipes[-1]

    def note(self, what: str) -> Any:
        return lambda *args: self.done.append((what, *args))

    def of(self, what: str) -> list[Any]:
        return [args for name, *args in self.done if name == what]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


class Run:
    """The run's side of a process, which is a thread."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        files = anonymous_file(), anonymous_file()
        self.pipe = SharedPipe(ours, *(os.dup(file) for file in files))
        self.thread = threading.Thread(
            target=child.main, args=(theirs.detach(), *files, LIMIT), daemon=True
        )
        self.thread.start()

    def begin(self, cores: tuple[int, ...] = (), module: str = __name__) -> None:
        self.pipe.send((sys.path, 7, cores, module))

    def ask(self, *message: Any) -> Any:
        """Send a message, and return whether it succeeded, its result, and its two times."""
        self.pipe.send(message)
        return self.pipe.receive()

    def close(self) -> None:
        self.pipe.shut_down()
        self.thread.join(10)
        assert not self.thread.is_alive()


@pytest.fixture
def run(machine: Machine) -> Iterator[Run]:
    run = Run()
    yield run
    run.close()
    for pipe in (run.pipe, *machine.pipes):
        pipe.close()


class Plant:
    closed: ClassVar[int] = 0

    def __init__(self, trouble: str = "") -> None:
        if trouble:
            raise SystemExit(trouble)

    def grow(self, by: int, *, times: int = 1) -> int:
        return by * times

    def fail(self) -> None:
        raise LookupError("no water")

    def lock(self) -> Any:
        return threading.Lock()

    def image(self) -> Any:
        return np.arange(100_000)

    def close(self) -> None:
        Plant.closed += 1


class Simple:
    """Has nothing to close."""


def test_calls_are_answered_with_their_times_until_the_run_closes_the_connection(
    run: Run,
) -> None:
    Plant.closed = 0
    run.begin()
    assert run.ask(Plant, ()) == (True, None, 0, 0)  # making the object is no call
    succeeded, result, wall, cpu = run.ask("grow", (3,), {"times": 2})
    assert (succeeded, result) == (True, 6)
    assert 0 < wall < 20e9
    assert 0 <= cpu < 20e9
    assert np.array_equal(run.ask("image", (), {})[1], np.arange(100_000))
    assert Plant.closed == 0
    run.close()
    assert Plant.closed == 1


def test_an_error_is_answered_and_the_next_call_too(run: Run) -> None:
    run.begin()
    assert run.ask(Plant, ())[0]
    succeeded, error, wall, _ = run.ask("fail", (), {})
    assert not succeeded
    assert wall > 0
    assert isinstance(error, PortableError)
    assert error.text == "LookupError: no water"
    assert error.place.startswith(f"{__file__}:")
    assert error.place.endswith(" in fail")
    succeeded, error, *_ = run.ask("lock", (), {})
    assert not succeeded
    assert "cannot pickle" in error.text
    assert run.ask("grow", (3,), {})[:2] == (True, 3)


@pytest.mark.parametrize(
    ("module", "trouble", "text"),
    [(__name__, "no seed", "SystemExit: no seed"), ("no_such_module", "", "ModuleNotFoundError: ")],
)
def test_an_object_that_cannot_be_made_is_the_last_answer(
    module: str, trouble: str, text: str, run: Run
) -> None:
    Plant.closed = 0
    run.begin(module=module)
    succeeded, error, *times = run.ask(Plant, (trouble,))
    assert (succeeded, times) == (False, [0, 0])
    assert error.text.startswith(text)
    run.thread.join(10)
    assert not run.thread.is_alive()
    assert Plant.closed == 0


def test_an_object_need_not_have_anything_to_close(run: Run) -> None:
    run.begin()
    assert run.ask(Simple, ())[0]
    run.close()


@pytest.mark.parametrize("cores", [(), (2, 3)])
def test_a_process_stands_back_for_the_loop(
    cores: tuple[int, ...], run: Run, machine: Machine
) -> None:
    run.begin(cores)
    run.ask(Plant, ())
    assert machine.of("nice") == [[7]]
    assert [(pid, policy) for pid, policy, _ in machine.of("scheduler")] == [(0, os.SCHED_BATCH)]
    assert machine.of("cores") == ([[0, cores]] if cores else [])
    assert machine.of("signal") == [[signal.SIGINT, signal.SIG_IGN]]


def test_every_step_has_a_limit_of_the_kernel_and_waiting_has_none(
    run: Run, machine: Machine
) -> None:
    """Processor time of all processors; and ten times the limit of real time."""
    on = [[signal.ITIMER_PROF, LIMIT * 4], [signal.ITIMER_REAL, LIMIT * 10]]
    off = [[signal.ITIMER_PROF, 0], [signal.ITIMER_REAL, 0]]
    run.begin()
    run.ask(Plant, ())
    assert machine.of("limit") == (on + off) * 2  # the import, and making the object
    run.ask("fail", (), {})
    assert machine.of("limit") == (on + off) * 3
    run.close()
    assert machine.of("limit") == (on + off) * 3 + on  # for its close


def test_a_process_outlives_its_run_for_a_moment_only(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []
    monkeypatch.setattr(time, "sleep", lambda seconds: done.append(("wait", seconds)))
    monkeypatch.setattr(os, "getpgrp", os.getpid)
    monkeypatch.setattr(os, "killpg", lambda *args: done.append(("end", *args)))
    monkeypatch.setattr(os, "_exit", lambda code: done.append(("exit", code)))
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ending = threading.Thread(target=child._end_with_the_run, args=(theirs,))
        ending.start()
        ours.send(b"a message is no end")
        assert not done
        ours.close()
        ending.join(10)
    (wait, seconds), *end = done
    assert wait == "wait"
    assert 1.0 <= seconds <= 10.0
    assert end == [("end", 0, signal.SIGKILL), ("exit", 1)]


def test_a_process_of_another_group_ends_that_of_nobody_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    killed: list[Any] = []
    monkeypatch.setattr(os, "killpg", lambda *args: killed.append(args))
    monkeypatch.setattr(os, "getpgrp", lambda: os.getpid() + 1)
    child._end_group(signal.SIGTERM)
    assert killed == []
