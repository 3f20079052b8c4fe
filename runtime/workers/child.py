"""Main program of a worker's process: an object, and the calls of its methods, in order.

Started by `runtime.workers.worker` as ``python -m runtime.workers.child SOCKET IN OUT LIMIT``:
inherited file descriptors, and the seconds that a call may take. The process ends with the run,
however the run ends: in order if it waits for calls; after `_GRACE` if it is in one, and if that
call does not even let go of Python's lock, once its limit is over.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import select
import signal
import socket
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from runtime.workers.output import PortableError
from runtime.workers.shared_memory import SharedPipe

_LIBRARIES = tuple(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
"""Folders of libraries: code not of the worker's own."""

_GRACE = 5.0  # seconds for a call to end, and the object to close, once the run has gone
_MOST_STARVED = 10  # how many times longer a call may take on a busy machine


def main(socket_fd: int, in_fd: int, out_fd: int, limit: float) -> None:
    """Make the object, then answer calls until the other side closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the run's business
    for fd in (socket_fd, in_fd, out_fd):
        os.set_inheritable(fd, False)  # what the object starts has no part in this
    connection = socket.socket(fileno=socket_fd)
    threading.Thread(target=_end_with_the_run, args=(connection,), daemon=True).start()
    pipe = SharedPipe(connection, out_fd, in_fd)
    made = False
    target: Any = None
    try:
        # First, because the next message names what to import.
        begun, error = _attempt(limit, _begin, *pipe.receive())
        message = pipe.read()
        made, target = _attempt(limit, _make, pipe, message) if begun else (False, error)
        _answer(pipe, made, None if made else target, 0, 0)
        cpu = time.process_time_ns()
        while made:
            message = pipe.read()
            begin = time.perf_counter_ns()
            outcome = _attempt(limit, _call, pipe, message, target)
            wall = time.perf_counter_ns() - begin
            before, cpu = cpu, time.process_time_ns()
            _answer(pipe, *outcome, wall, cpu - before)
            del outcome  # or the arrays in it would live until the next call has ended
    except (EOFError, OSError):
        pass  # the run closed the connection, or is gone
    finally:
        if made and hasattr(target, "close"):
            _limit(limit)
            target.close()


def _end_with_the_run(connection: socket.socket) -> None:
    gone = select.poll()
    gone.register(connection, 0)  # which leaves POLLHUP
    gone.poll()
    time.sleep(_GRACE)
    _end_group(signal.SIGKILL)
    os._exit(1)


def _end_group(number: signal.Signals) -> None:
    if os.getpgrp() == os.getpid():
        os.killpg(0, number)


def _begin(path: list[str], niceness: int, cores: tuple[int, ...], module: str) -> None:
    """Import the object's module, while the run prepares what the object is made from."""
    sys.path[:] = path
    os.nice(niceness)
    _print_lines()
    if hasattr(os, "SCHED_BATCH"):  # which, when it wakes, does not push the loop off its core
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    if cores:  # before any library starts threads, which inherit it
        os.sched_setaffinity(0, cores)
    importlib.import_module(module)


def _print_lines() -> None:
    """Have C and C++ libraries print each line as it ends: into a pipe they print 4 KB at a time.

    Python itself is told so by its environment. By setvbuf(3); `_IOLBF` is 1 in glibc and musl.
    """
    library = ctypes.CDLL(None)
    with contextlib.suppress(ValueError, AttributeError):  # a C library with other names
        library.setvbuf(ctypes.c_void_p.in_dll(library, "stdout"), None, 1, ctypes.c_size_t(0))


def _make(pipe: SharedPipe, message: bytearray) -> Any:
    factory, args = pipe.unpack(message)
    return factory(*args)


def _call(pipe: SharedPipe, message: bytearray, target: Any) -> Any:
    method, args, kwargs = pipe.unpack(message)
    return getattr(target, method)(*args, **kwargs)


def _attempt(limit: float, do: Callable[..., Any], *args: Any) -> tuple[bool, Any]:
    """Return True and a result, or False and an error; or end the process after `limit` seconds.

    The run has its own eye on that: this is for when there is none any more, so the kernel does it.
    """
    _limit(limit)
    try:
        return True, do(*args)
    except BaseException as error:  # also SystemExit: it is the call that fails
        return False, _portable(error)
    finally:
        _limit(0)


def _limit(seconds: float) -> None:
    """Let the kernel end this process after so many seconds with a processor; 0 for never.

    Threads on all processors do not use that up sooner. One that only waits has ten times as long:
    how busy the machine is, a clock does not tell.
    """
    signal.setitimer(signal.ITIMER_PROF, seconds * (os.cpu_count() or 1))
    signal.setitimer(signal.ITIMER_REAL, seconds * _MOST_STARVED)


def _answer(pipe: SharedPipe, succeeded: bool, result: Any, wall: int, cpu: int) -> None:
    try:
        packed = pipe.pack((succeeded, result, wall, cpu))
    except BaseException as error:  # the result cannot be pickled
        packed = pipe.pack((False, _portable(error), wall, cpu))
    pipe.write(packed)


def _portable(error: BaseException) -> PortableError:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__]
    frames = [f for f in frames if not f.filename.startswith(_LIBRARIES)] or frames
    place = f"{frames[-1].filename}:{frames[-1].lineno} in {frames[-1].name}" if frames else ""
    return PortableError.of(error, place)


if __name__ == "__main__":
    socket_fd, in_fd, out_fd = map(int, sys.argv[1:4])
    main(socket_fd, in_fd, out_fd, float(sys.argv[4]))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _end_group(signal.SIGTERM)
