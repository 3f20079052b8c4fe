"""What runs in a worker's process: one object, and the calls that arrive for it, in order.

Started by `runtime.worker` as ``python -m runtime.worker_process SOCKET IN OUT``; the numbers are
inherited file descriptors.
"""

from __future__ import annotations

import os
import signal
import sys
from multiprocessing.connection import Connection
from typing import Any

from runtime.shared import SharedPipe


def main(socket_fd: int, in_fd: int, out_fd: int) -> None:
    """Make the object, then answer calls until the other side closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the run's business
    pipe = SharedPipe(Connection(socket_fd), out_fd, in_fd)
    target: Any = None
    try:
        sys.path[:] = pipe.receive()  # first, because the next message names what to import
        factory, args, niceness = pipe.receive()
        os.nice(niceness)
        target = factory(*args)
        pipe.send((True, None))
        while True:
            method, args, kwargs = pipe.receive()
            try:
                outcome = (True, getattr(target, method)(*args, **kwargs))
            except Exception as error:
                outcome = (False, _portable(error))
            args = kwargs = None  # frees the arrays that came with the call
            pipe.send(outcome)
            outcome = (True, None)
    except (EOFError, OSError):
        pass  # the run closed the connection, or is gone
    except Exception as error:  # the object could not be made
        pipe.send((False, _portable(error)))
    finally:
        if hasattr(target, "close"):
            target.close()


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
