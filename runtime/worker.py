"""An object in processes of its own, called from the loop: rendering, SLAM, mapping.

    self.renderer = await self.worker(Renderer, model, processes=2, latency=0.04)
    frame = await self.renderer.call(Renderer.render, state)

The object is made in a freshly started Python (never a fork: OpenGL and threads do not survive
one), arrays pass through shared memory, and a process that dies or hangs fails the calls that
wait for it with its name, its exit code and the last that it printed.
"""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from runtime.clock import Clock
from runtime.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from runtime.schedule import SECOND
from runtime.shared import SharedPipe, anonymous_file

W = TypeVar("W")
R = TypeVar("R")
P = ParamSpec("P")

_GRACE = 2.0
"""Seconds a process gets to end by itself once its connection is closed."""


class Worker(Generic[W]):
    """One object, or several alike, each in its own process.

    Args:
        name: For messages.
        clock: The run's clock.
        factory: A class (or function) of an importable module; called in the process.
        args: Its arguments.
        processes: How many; each call goes to the one with the fewest calls outstanding.
        latency: Seconds of the run's clock from a call to its result.
        timeout: Real seconds after which a call that has no answer is a `WorkerTimeoutError`.
        env: Environment variables for the processes, added to ours.
        niceness: How much the processes stand back for others, 0 to 19. In real time they also
            keep off one core, so that a tick need not wait for a core to come free.
        printed: Told each line that a process prints.
        died: Told when a process ends on its own or is killed for hanging; from any thread.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        factory: Callable[..., W],
        *args: Any,
        processes: int = 1,
        latency: float = 0.0,
        timeout: float = 60.0,
        env: Mapping[str, str] | None = None,
        niceness: int = 5,
        printed: Callable[[str], None] = lambda _: None,
        died: Callable[[WorkerError], None] = lambda _: None,
    ) -> None:
        if getattr(factory, "__module__", "__main__") == "__main__":
            raise WorkerError(
                f"{name}: expected a class of a module that a worker can import, "
                f"found {factory!r} of __main__"
            )
        self.name = name
        self._clock = clock
        self._latency = latency
        environment = {**os.environ, **(env or {})}
        self._processes = [
            _Process(f"{name}[{n}]" if processes > 1 else name, timeout, environment, printed, died)
            for n in range(processes)
        ]
        cores = _spare_cores() if clock.kind == "real" else None
        self._started = [p.start(factory, args, niceness, cores) for p in self._processes]

    async def ready(self) -> None:
        """Wait until the object has been made in every process.

        Raises:
            WorkerError: A process died or hung; or whatever making the object raised.
        """
        for started in self._started:
            await self._clock.beside(started)

    async def call(
        self, method: Callable[Concatenate[W, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a method of the object and await its result, `latency` later.

        Args:
            method: The function as it stands in the class: ``Renderer.render``.
            args: Its arguments; large arrays pass through shared memory.
            kwargs: The same.

        Raises:
            WorkerDiedError: The process ended.
            WorkerTimeoutError: It did not answer within its time limit, and was killed.
        """
        return await self.call_for(self._latency, method, *args, **kwargs)

    async def call_for(
        self,
        latency: float,
        method: Callable[Concatenate[W, P], R],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> R:
        """Call a method as `call` does, with a latency (seconds of the clock) of its own."""
        process = min(self._processes, key=_Process.outstanding)
        work = process.request((method.__name__, args, kwargs))
        result: R = await self._clock.beside(work, round(latency * SECOND))
        return result

    def outstanding(self) -> int:
        """Return how many calls wait for their answer."""
        return sum(p.outstanding() for p in self._processes)

    def close(self) -> None:
        """End the processes; calls still waiting fail. Takes up to a few seconds: not on a loop."""
        for process in self._processes:
            process.close()
        for process in self._processes:
            process.join()


def _spare_cores() -> set[int] | None:
    """Return all cores but one, which is left to the loop; `None` where there is no choice.

    On two cores with a camera rendering, this brings the 99th percentile of a 400 Hz tick's
    lateness from three times that without a camera down to the same.
    """
    if not hasattr(os, "sched_getaffinity"):
        return None
    cores = sorted(os.sched_getaffinity(0))
    return set(cores[1:]) or None


class _Process:
    """One process and the calls on their way to and from it."""

    def __init__(
        self,
        name: str,
        timeout: float,
        environment: Mapping[str, str],
        printed: Callable[[str], None],
        died: Callable[[WorkerError], None],
    ) -> None:
        self._name = name
        self._timeout = timeout
        self._printed = printed
        self._died = died
        self._calls: collections.deque[tuple[float, concurrent.futures.Future[Any]]] = (
            collections.deque()
        )
        self._lock = threading.Lock()
        self._closing = False
        self._error: WorkerError | None = None
        self._tail: collections.deque[str] = collections.deque(maxlen=20)
        ours, theirs = socket.socketpair()
        files = anonymous_file(), anonymous_file()
        numbers = theirs.fileno(), *files
        self._child = subprocess.Popen(  # noqa: S603  # our own module
            [sys.executable, "-m", "runtime.worker_process", *map(str, numbers)],
            pass_fds=numbers,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            process_group=0,  # so that a terminal's Ctrl-C does not reach it
            env={**environment, "PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        theirs.close()
        self._pipe = SharedPipe(Connection(ours.detach()), *files)
        self._output = threading.Thread(target=self._read_output, name=name, daemon=True)
        self._reader = threading.Thread(target=self._read_answers, name=name, daemon=True)

    def start(
        self,
        factory: Callable[..., Any],
        args: tuple[Any, ...],
        niceness: int,
        cores: set[int] | None,
    ) -> concurrent.futures.Future[Any]:
        """Have the object made; the future tells whether that went well."""
        self._output.start()
        with contextlib.suppress(OSError):  # if it is gone already, the request below says so
            self._pipe.send(sys.path)
        started = self.request((factory, args, niceness, cores))
        self._reader.start()
        return started

    def outstanding(self) -> int:
        return len(self._calls)

    def request(self, message: Any) -> concurrent.futures.Future[Any]:
        """Send a message and return the future of its answer; from the loop's thread only."""
        work: concurrent.futures.Future[Any] = concurrent.futures.Future()
        work.set_running_or_notify_cancel()  # whoever stops waiting does not cancel it
        with self._lock:
            if self._error is not None:
                work.set_exception(self._error)
                return work
            self._calls.append((time.monotonic() + self._timeout, work))
        try:
            self._pipe.send(message)
        except OSError:  # the reader finds out why, and fails this call with the others
            pass
        except Exception as error:  # it cannot be pickled: the caller's mistake
            with self._lock:
                self._calls.pop()
            work.set_exception(error)
        return work

    def _read_answers(self) -> None:
        try:
            while True:
                if not self._pipe.poll(0.25):
                    if self._calls and time.monotonic() > self._calls[0][0]:
                        self._child.kill()
                        raise WorkerTimeoutError(self._story(f"no answer in {self._timeout:g} s"))
                    continue
                succeeded, result = self._receive()
                with self._lock:
                    _, work = self._calls.popleft()
                if succeeded:
                    work.set_result(result)
                else:
                    work.set_exception(result)
                del result, work  # or the last arrays would live until the next answer
        except (EOFError, OSError):
            error: WorkerError = WorkerDiedError(self._story(self._exit()))
        except WorkerTimeoutError as hung:
            error = hung
        self._fail(error)

    def _receive(self) -> tuple[bool, Any]:
        try:
            answer: tuple[bool, Any] = self._pipe.receive()
        except (EOFError, OSError):
            raise
        except Exception as error:  # it cannot be unpickled: this call fails, the next may not
            return False, error
        return answer

    def _fail(self, error: WorkerError) -> None:
        expected = self._closing
        with self._lock:
            self._error = error
            calls, self._calls = self._calls, collections.deque()
        for _, work in calls:
            work.set_exception(error)
        if not expected:
            self._died(error)

    def _exit(self) -> str:
        try:
            code = self._child.wait(_GRACE)
        except subprocess.TimeoutExpired:
            return "closed its connection"
        return f"killed by signal {-code}" if code < 0 else f"ended with exit code {code}"

    def _story(self, what: str) -> str:
        self._output.join(_GRACE)
        tail = "; its last output:\n" + "\n".join(self._tail) if self._tail else "; it said nothing"
        return f"worker {self._name}: {what}{tail}"

    def _read_output(self) -> None:
        assert self._child.stdout is not None
        with self._child.stdout as lines:
            for line in lines:
                text = line.decode(errors="replace").rstrip()
                self._tail.append(text)
                self._printed(text)

    def close(self) -> None:
        """Tell the process to end."""
        self._closing = True
        self._pipe.shut_down()

    def join(self) -> None:
        """Wait until it has ended, by force if need be."""
        try:
            self._child.wait(_GRACE)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._reader.join()
        self._output.join()
        self._pipe.close()
