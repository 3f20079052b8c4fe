"""An object in processes of its own, called from the loop: rendering, SLAM, mapping.

    self.renderer = await self.worker(Renderer, model, processes=2, latency=0.04)
    frame = await self.renderer.call(Renderer.render, state)

The object is made in a freshly started Python (never a fork: OpenGL and threads do not survive
one), arrays pass through shared memory, and a process that dies or hangs fails the calls that
wait for it with its name, its exit code and the last that it printed.
"""

from __future__ import annotations

import asyncio
import collections
import concurrent.futures
import contextlib
import functools
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from runtime.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from runtime.time.clock import SECOND, Clock, result_of
from runtime.time.real_time import Starvation
from runtime.workers.costs import Costs
from runtime.workers.output import Output, Throttle, how_it_ended
from runtime.workers.shared_memory import SharedPipe, anonymous_file

W = TypeVar("W")
R = TypeVar("R")
P = ParamSpec("P")

Called = Callable[[str, str, concurrent.futures.Future[Any]], None]
"""Callback for a call: names of process and method, and the future of the answer."""

_GRACE = 2.0  # seconds a process gets to end by itself once its connection is closed
_LOOK = 0.25  # seconds without data until a thread checks whether its process is still there
_LONGEST = 1e8  # seconds of the longest limit given to the kernel


class Worker(Generic[W]):
    """An object, or several alike, each in its own process.

    The processes begin with `ready` and end with `close`, whatever is cancelled in between.

    Args:
        factory: A class (or function) of an importable module; called in the process.
        more: Called once the processes have begun, and awaited while they import: the last of the
            factory's arguments.
        processes: How many; each call goes to the one with the fewest calls outstanding.
        latency: Seconds of the run's clock from a call to its result.
        timeout: Real seconds after which a call that has no answer is a `WorkerTimeoutError`.
        env: Environment variables for the processes, added to ours.
        niceness: How much the processes stand back for others, 0 to 19. None pushes another off its
            core when it wakes, and in real time they keep off one core, so that a tick need not
            wait for a core to come free.
        printed: Called with lines that the processes print, at most so many a second as a
            `Throttle` lets pass.

    Raises:
        WorkerError: The factory is of no module that a process could import.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        factory: Callable[..., W],
        *args: Any,
        more: Callable[[], Awaitable[tuple[Any, ...]]] | None = None,
        processes: int = 1,
        latency: float = 0.0,
        timeout: float = 60.0,
        env: Mapping[str, str] | None = None,
        niceness: int = 5,
        printed: Callable[[str], None] = lambda _: None,
        died: Callable[[WorkerError], None] = lambda _: None,
        costs: Costs | None = None,
    ) -> None:
        if getattr(factory, "__module__", "__main__") == "__main__":
            raise WorkerError(
                f"{name}: expected a class of a module that a worker can import, "
                f"found {factory!r} of __main__"
            )
        self.name = name
        self.costs = costs or Costs()
        self.costs.latency = latency
        self.costs.processes = processes
        self.called: Called | None = None  # callback for every call, if set
        self._clock = clock
        self._latency = latency
        self._processes: list[_Process] = []
        self._changing = threading.Lock()
        self._closed = False
        self._printed = Throttle(printed)
        environment = {**os.environ, **(env or {})}
        names = [f"{name}[{n}]" for n in range(processes)] if processes > 1 else [name]
        self._make = [
            functools.partial(_Process, name, timeout, environment, self._printed, died, self.costs)
            for name in names
        ]
        cores = spare_cores() if clock.kind == "real" else ()
        self._conditions = sys.path, niceness, cores, factory.__module__
        self._factory, self._args, self._more = factory, args, more

    async def ready(self) -> None:
        """Start the processes, and wait until each has made its object.

        Raises:
            WorkerError: A process died or hung; or whatever making the object raised.
        """
        begun = await asyncio.to_thread(self._begin)  # which takes milliseconds
        more = await self._more() if self._more else ()
        args = *self._args, *more
        for made in await asyncio.to_thread(self._start, begun, args):
            await self._clock.beside(made)

    def _begin(self) -> list[_Process]:
        """Start the processes that are missing."""
        with self._unless_closed():
            begun = []
            for make in self._make[len(self._processes) :]:
                self._processes.append(make())
                self._processes[-1].begin(self._conditions)
                begun.append(self._processes[-1])
            return begun

    def _start(
        self, begun: list[_Process], args: tuple[Any, ...]
    ) -> list[concurrent.futures.Future[Any]]:
        with self._unless_closed():
            return [process.request((self._factory, args)) for process in begun]

    @contextlib.contextmanager
    def _unless_closed(self) -> Iterator[None]:
        with self._changing:
            if self._closed:  # its caller has gone before this thread came to it
                raise WorkerError(f"worker {self.name}: closed before it was ready")
            yield

    async def call(
        self, method: Callable[Concatenate[W, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a method of the object and await its result, `latency` later.

        Args:
            method: The function as it stands in the class: ``Renderer.render``.

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
        work = self._request(method, args, kwargs)
        if latency != self.costs.latency:
            self.costs.latency = None
        result: R = await self._clock.beside(work, round(latency * SECOND))
        return result

    async def call_untimed(
        self, method: Callable[Concatenate[W, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a method and await its result; simulated time does not wait meanwhile.

        For what leaves the run, such as an image for a client outside: at which simulated time the
        result comes is not the same in every run, unless time stands meanwhile.
        """
        self.costs.latency = None
        return await result_of(self._request(method, args, kwargs))

    def _request(
        self, method: Callable[..., R], args: Any, kwargs: Any
    ) -> concurrent.futures.Future[R]:
        if not self._processes:
            raise WorkerError(f"worker {self.name}: expected a call from ready() until close()")
        process = min(self._processes, key=_Process.outstanding)
        work = process.request((method.__name__, args, kwargs))
        if self.called is not None:
            self.called(process.name, method.__name__, work)
        return work

    def outstanding(self) -> int:
        """Return how many calls wait for their answer."""
        return sum(p.outstanding() for p in self._processes)

    def close(self) -> None:
        """End the processes; calls still waiting fail. Takes up to a few seconds: not on a loop."""
        self._closed = True
        with self._changing:
            processes, self._processes = self._processes, []
            for process in processes:
                process.close()
            until = time.monotonic() + _GRACE
            for process in processes:
                process.join(until)
        self._printed.end()


def spare_cores() -> tuple[int, ...]:
    """Return all cores but the first, left to the loop; none if there is no other.

    On two cores with a camera rendering, this brings the 99th percentile of a 400 Hz tick's
    lateness from three times that without a camera down to the same.
    """
    if not hasattr(os, "sched_getaffinity"):
        return ()
    return tuple(sorted(os.sched_getaffinity(0))[1:])


class _Process:
    """A process, and its calls in both directions.

    Only its own end counts: processes started by it may live on, and hold its connection and its
    output open.
    """

    def __init__(
        self,
        name: str,
        timeout: float,
        environment: Mapping[str, str],
        printed: Callable[[str], None],
        died: Callable[[WorkerError], None],
        costs: Costs,
    ) -> None:
        self.name = name
        self._timeout = timeout
        self._died = died
        self._costs = costs
        self._awaited: concurrent.futures.Future[Any] | None = None
        self._starvation = Starvation()
        self._looked = -math.inf  # at its memory, on `time.monotonic`
        self._calls: collections.deque[tuple[float, concurrent.futures.Future[Any]]] = (
            collections.deque()
        )
        self._lock = threading.Lock()
        self._closing = False
        self._error: WorkerError | None = None
        self._lines = Output(printed)
        ours, theirs = socket.socketpair()
        limit = min(timeout, _LONGEST)
        ours.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", int(limit) + 1, 0)
        )
        files = anonymous_file(), anonymous_file()
        numbers = theirs.fileno(), *files
        self._pipe = SharedPipe(ours, *files)
        python = {"PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-m", "runtime.workers.child", *map(str, numbers)]
        try:
            self._child = subprocess.Popen(  # noqa: S603  # our own module
                [*command, str(limit + _GRACE)],
                pass_fds=numbers,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                process_group=0,  # so that a terminal's Ctrl-C does not reach it
                env={**environment, **python},
            )
        except BaseException:
            self._pipe.close()
            raise
        finally:
            theirs.close()
        self._output = threading.Thread(target=self._read_output, name=name, daemon=True)
        self._reader = threading.Thread(target=self._read_answers, name=name, daemon=True)

    def begin(self, conditions: Any) -> None:
        """Have the process import what it will need."""
        self._output.start()
        with contextlib.suppress(OSError):  # if it is gone already, a request says so
            self._pipe.send(conditions)
        self._reader.start()

    def outstanding(self) -> int:
        return len(self._calls)

    def request(self, message: Any) -> concurrent.futures.Future[Any]:
        """Send a message and return the future of its answer; the first is what makes the object.

        It never waits for the process to take it.
        """
        work: concurrent.futures.Future[Any] = concurrent.futures.Future()
        work.set_running_or_notify_cancel()  # a caller that stops waiting does not cancel it
        try:
            packed = self._pipe.pack(message)
        except Exception as error:  # it cannot be pickled: the caller's mistake
            work.set_exception(error)
            return work
        with self._lock:
            if self._error is not None:
                work.set_exception(self._error)
                return work
            self._calls.append((time.monotonic() + self._timeout, work))
        with contextlib.suppress(OSError):  # the reader finds out why, and fails this call, too
            self._pipe.post(packed)
        return work

    def _read_answers(self) -> None:
        try:
            while True:
                if self._pipe.poll(_LOOK):
                    self._read_answer()
                elif self._child.poll() is not None and not self._pipe.poll(0):
                    raise EOFError  # that a fork of it holds back
                else:
                    self._check_limit()
        except BlockingIOError:  # it stopped in the middle of an answer
            error: WorkerError = self._hung()
        except (EOFError, OSError):
            error = WorkerDiedError(self._story(self._exit()))
        except WorkerTimeoutError as hung:
            error = hung
        except Exception as unexpected:  # such as a second answer, by a fork of it
            self._kill()
            error = WorkerDiedError(self._story(f"expected an answer, found {unexpected!r}"))
        self._fail(error)

    def _read_answer(self) -> None:
        message = self._pipe.read()
        try:
            succeeded, result, wall, cpu = self._pipe.unpack(message)
            result = result if succeeded else result.restored()
        except BaseException as error:  # this call fails, the next may not
            succeeded, result, wall, cpu = False, error, 0, 0
        now = time.monotonic()
        if now >= self._looked + 1:
            self._looked = now
            self._costs.look_at(self._child.pid)
        if wall:  # making the object is no call
            self._costs.add(wall, cpu)
        with self._lock:
            _, work = self._calls.popleft()
        if succeeded:
            work.set_result(result)
        else:
            work.set_exception(result)

    def _check_limit(self) -> None:
        with self._lock:
            due, work = self._calls[0] if self._calls else (math.inf, None)
        if work is not self._awaited:
            self._awaited, self._starvation = work, Starvation(self._child.pid)
        if due < math.inf and time.monotonic() > due + self._starvation.look():
            raise self._hung()

    def _hung(self) -> WorkerTimeoutError:
        self._kill()
        return WorkerTimeoutError(
            self._story(f"no answer in {self._timeout:g} s (timeout of self.worker)")
        )

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
            return how_it_ended(self._child.wait(_GRACE))
        except subprocess.TimeoutExpired:
            return "closed its connection"

    def _story(self, what: str) -> str:
        self._output.join(_GRACE)
        return self._lines.story(f"worker {self.name}: {what}")

    def _read_output(self) -> None:
        """Read the process's output until its end, even if others could write there."""
        assert self._child.stdout is not None
        readable = select.poll()
        readable.register(self._child.stdout, select.POLLIN)
        with self._child.stdout as output:
            while True:
                ended = self._child.poll() is not None
                if not readable.poll(0 if ended else _LOOK * 1e3):
                    if ended:
                        break
                    continue
                read = os.read(output.fileno(), 1 << 16)
                if not read:
                    break
                self._lines.add(read)
        self._lines.end()

    def close(self) -> None:
        """Tell the process to end."""
        self._closing = True
        self._costs.look_at(self._child.pid)
        self._pipe.shut_down()

    def _kill(self) -> None:
        with contextlib.suppress(OSError):
            os.killpg(self._child.pid, signal.SIGKILL)

    def join(self, until: float) -> None:
        """Wait for the end, by force if still running at a time of `time.monotonic`."""
        try:
            self._child.wait(max(until - time.monotonic(), 0))
        except subprocess.TimeoutExpired:
            self._kill()
            self._child.wait()
        self._kill()
        self._reader.join()
        self._output.join(_GRACE)
        self._pipe.close()
