"""Running a loop to the end of a coroutine, and closing it, whatever its tasks do.

Unlike `asyncio.Runner`, this survives a `SystemExit` or `KeyboardInterrupt` that some task or
callback lets out of the loop, and waits a limited time for tasks that swallow their cancellation.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from runtime.run.task_factory import RunTask

R = TypeVar("R")

GRACE = 1.0
"""Real seconds in which tasks and asynchronous generators must end when the loop is closed."""

_MOST_ESCAPES = 100

LEFT: list[Any] = []
"""Tasks that would not end. They are kept: thrown away, they would complain on standard error. A
process in which there are some must end by `os._exit`."""


def run_to_end(
    loop: asyncio.AbstractEventLoop,
    main: Coroutine[Any, Any, R],
    escaped: Callable[[BaseException], None],
) -> R:
    """Run a loop until a coroutine is done, close the loop, and return the coroutine's result.

    Args:
        loop: Not running yet.
        main: What to run.
        escaped: Called with errors of the loop while `main` is not done; the loop then goes on,
            unless this raises.

    Raises:
        BaseException: Whatever `main` raises.
    """
    try:
        task = RunTask(0, main, loop=loop, name="the run")
        task.protected = True
        escapes = 0
        while not task.done():
            try:
                loop.run_until_complete(task)
            except BaseException as error:
                if task.done():
                    break
                escapes += 1
                if escapes > _MOST_ESCAPES:
                    raise
                escaped(error)
        result: R = task.result()
        return result
    finally:
        _close(loop)


def _close(loop: asyncio.AbstractEventLoop) -> None:
    tasks = asyncio.all_tasks(loop)
    for task in tasks:
        task.cancel()
    if tasks:
        _run_for(loop, asyncio.wait(tasks), GRACE)
    _run_for(loop, loop.shutdown_asyncgens(), GRACE)
    for task in [task for task in tasks if not task.done()]:
        task._log_destroy_pending = False  # type: ignore[attr-defined]
        LEFT.append(task)
    loop.close()


def _run_for(
    loop: asyncio.AbstractEventLoop, coro: Coroutine[Any, Any, Any], seconds: float
) -> None:
    """Run a loop until a coroutine is done, for so many real seconds at most."""
    task = loop.create_task(coro)
    task.add_done_callback(lambda _: loop.stop())

    def ring() -> None:
        with contextlib.suppress(RuntimeError):  # closed
            loop.call_soon_threadsafe(loop.stop)

    timer = threading.Timer(seconds, ring)
    timer.daemon = True
    timer.start()
    with contextlib.suppress(SystemExit, KeyboardInterrupt):
        loop.run_forever()
    timer.cancel()
    if not task.done():
        task.cancel()
        loop.call_soon(loop.stop)
        with contextlib.suppress(SystemExit, KeyboardInterrupt):
            loop.run_forever()
    elif not task.cancelled():
        task.exception()
