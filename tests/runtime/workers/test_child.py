"""The main program of a worker's process, run in a thread here: what it answers, and its limits."""

from __future__ import annotations

import ctypes
import json
import os
import queue
import signal
import socket
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from types import SimpleNamespace
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
        monkeypatch.setattr(child, "_end_with_the_run", self._watch)
        monkeypatch.setattr(child, "_print_lines", self.note("print lines"))
        monkeypatch.setattr(sys, "path", list(sys.path))
        monkeypatch.setattr(child, "SharedPipe", self._pipe)
        self.pipes: list[SharedPipe] = []  # which the end of a process would close
        self.watches: queue.Queue[tuple[int, bool]] = queue.Queue()
        """Connections whose end is watched, and whether the thread is a daemon."""

    def _pipe(self, *args: Any) -> SharedPipe:
        self.pipes.append(SharedPipe(*args))
        return self.pipes[-1]

    def _watch(self, connection: socket.socket) -> None:
        self.watches.put((connection.fileno(), threading.current_thread().daemon))

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
        self.fds = (theirs.detach(), *files)
        for fd in self.fds:
            os.set_inheritable(fd, True)  # as a process inherits them
        self.thread = threading.Thread(target=child.main, args=(*self.fds, LIMIT), daemon=True)
        self.thread.start()

    def begin(
        self, cores: tuple[int, ...] = (), module: str = __name__, folders: tuple[str, ...] = ()
    ) -> None:
        self.pipe.send(([*sys.path, *folders], 7, cores, module))

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
    freed: ClassVar[threading.Event] = threading.Event()

    def __init__(self, trouble: str = "") -> None:
        if trouble:
            raise SystemExit(trouble)

    def grow(self, by: int, *, times: int = 1) -> int:
        return by * times

    def fail(self) -> None:
        raise LookupError("no water")

    def lock(self) -> Any:
        return threading.Lock()

    def parse(self, text: str) -> Any:
        return json.loads(text)

    def image(self) -> Any:
        image = np.arange(100_000)
        weakref.finalize(image, self.freed.set)
        return image

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


def test_times_of_a_call_are_its_own_but_processor_time_goes_on_after_an_answer(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What its threads do after an answer is counted with the next call."""
    clocks = SimpleNamespace(
        perf_counter_ns=iter([1000, 1500, 5000, 5001]).__next__,
        process_time_ns=iter([100, 250, 700]).__next__,
    )
    monkeypatch.setattr(child, "time", clocks)
    run.begin()
    run.ask(Plant, ())
    assert run.ask("grow", (1,), {}) == (True, 1, 500, 150)
    assert run.ask("grow", (1,), {}) == (True, 1, 1, 450)


def test_an_answer_is_kept_no_longer_than_it_takes_to_send(run: Run) -> None:
    """Or the images of two calls would be in memory at a time."""
    Plant.freed.clear()
    run.begin()
    run.ask(Plant, ())
    run.ask("image", (), {})
    assert Plant.freed.wait(10)


def test_the_place_of_an_error_is_in_code_of_the_workers_own(run: Run) -> None:
    run.begin()
    run.ask(Plant, ())
    _, error, *_ = run.ask("parse", ("{",), {})
    assert error.place.startswith(f"{__file__}:")
    assert error.place.endswith(" in parse")


def test_the_place_of_an_error_is_in_a_library_if_nowhere_else(run: Run) -> None:
    run.begin()
    succeeded, error, *_ = run.ask(json.loads, ("{",))
    assert not succeeded
    assert error.place.startswith(f"{json.decoder.__file__}:")


def test_an_error_of_no_code_has_no_place(run: Run) -> None:
    run.begin()
    assert run.ask(Plant, ())[0]
    succeeded, error, *_ = run.ask("no_method", (), {})
    assert (succeeded, error.place) == (False, "")
    assert error.text.startswith("AttributeError: ")


def test_a_process_has_the_modules_of_its_run_and_watches_for_the_runs_end(
    run: Run, machine: Machine
) -> None:
    run.begin(folders=("/somewhere/else",))
    run.ask(Plant, ())
    assert sys.path[-1] == "/somewhere/else"
    assert machine.watches.get(timeout=10) == (run.fds[0], True)
    assert machine.of("print lines") == [[]]


def test_what_an_object_starts_inherits_nothing_of_the_connection(run: Run) -> None:
    run.begin()
    run.ask(Plant, ())
    assert [os.get_inheritable(fd) for fd in run.fds] == [False] * 3


class Library(ctypes.CDLL):
    """The C library, which does not set how this process prints."""

    buffers: ClassVar[list[tuple[Any, ...]]] = []

    def setvbuf(self, stream: Any, buffer: Any, mode: int, size: Any) -> None:
        self.buffers.append((stream.value, buffer, mode, size.value))


class OtherLibrary(ctypes.CDLL):
    """A C library that names things otherwise."""

    @property
    def setvbuf(self) -> None:
        raise AttributeError


def test_c_libraries_print_lines_as_they_end(monkeypatch: pytest.MonkeyPatch) -> None:
    stdout = ctypes.c_void_p.in_dll(ctypes.CDLL(None), "stdout").value
    Library.buffers.clear()
    monkeypatch.setattr(ctypes, "CDLL", Library)
    child._print_lines()
    line_buffered = 1  # _IOLBF
    assert Library.buffers == [(stdout, None, line_buffered, 0)]
    monkeypatch.setattr(ctypes, "CDLL", OtherLibrary)
    child._print_lines()


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
    (scheduler,) = [(pid, policy, p.sched_priority) for pid, policy, p in machine.of("scheduler")]
    assert scheduler == (0, os.SCHED_BATCH, 0)  # the only priority that this policy has
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


def test_where_nobody_counts_processors_a_step_has_the_time_of_one(
    run: Run, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    run.begin()
    run.ask(Plant, ())
    assert machine.of("limit")[0] == [signal.ITIMER_PROF, LIMIT]


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
