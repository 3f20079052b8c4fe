"""What runs in a worker's process: one object, and the calls that arrive for it, in order.

Started by `runtime.worker` as ``python -m runtime.worker_process SOCKET IN OUT``; the numbers are
inherited file descriptors.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from runtime.shared import SharedPipe


def main(socket_fd: int, in_fd: int, out_fd: int) -> None:
    """Make the object, then answer calls until the other side closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the run's business
    pipe = SharedPipe(Connection(socket_fd), out_fd, in_fd)
    made = False
    target: Any = None
    try:
        sys.path[:] = pipe.receive()  # first, because the next message names what to import
        made, target = _attempt(lambda: _make(*pipe.receive()))
        pipe.send((made, None if made else target))
        while made:
            _answer(pipe, *_attempt(lambda: _call(target, *pipe.receive())))
    except (EOFError, OSError):
        pass  # the run closed the connection, or is gone
    finally:
        if made and hasattr(target, "close"):
            target.close()


def _make(
    factory: Callable[..., Any], args: tuple[Any, ...], niceness: int, cores: set[int] | None
) -> Any:
    os.nice(niceness)
    if cores is not None:  # before any library starts threads, which inherit it
        os.sched_setaffinity(0, cores)
    return factory(*args)


def _call(target: Any, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return getattr(target, method)(*args, **kwargs)


def _attempt(do: Callable[[], Any]) -> tuple[bool, Any]:
    """Return True and a result, or False and an error.

    At the end of the connection the error is its own, and sending it fails.
    """
    try:
        return True, do()
    except Exception as error:
        return False, _portable(error)


def _answer(pipe: SharedPipe, succeeded: bool, result: Any) -> None:
    try:
        pipe.send((succeeded, result))
    except OSError:
        raise
    except Exception as error:  # the result cannot be pickled
        pipe.send((False, _portable(error)))


def _portable(error: Exception) -> Exception:
    """Return the error with its traceback as text, since tracebacks cannot be pickled."""
    import pickle
    import traceback

    error.add_note("in the worker:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  # made a line above
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    main(*(int(number) for number in sys.argv[1:]))
