"""Event loops run until a coroutine ends, whatever their tasks do; tasks resumable by streams.

Unlike `asyncio.Runner`, `run_to_end` survives a `SystemExit` or `KeyboardInterrupt` that some task
or callback lets out of the loop, and waits a limited time for tasks that swallow their
cancellation.

`runtime.channels.tasks` relies on how asyncio's tasks work inside. At the first use in a process, a
self-test tries it; where the interpreter differs, tasks stay asyncio's own, which streams wake
through the loop: slower, with the same results.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import functools
import logging
import sys
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from runtime import code_location
from runtime.channels import tasks
from runtime.channels.streams import Stream
from runtime.channels.tasks import Nesting, ResumableCoroutine
from runtime.errors import NodeError
from runtime.time.lockstep import PYTHON, passes
from runtime.time.time_limits import call_after

log = logging.getLogger("visnav.runtime")

Factory = Callable[..., asyncio.Task[Any]]


def install(loop: asyncio.AbstractEventLoop) -> None:
    """Make every task created on `loop` from now on resumable by streams.

    If the interpreter does not allow it, its tasks stay as they are, and the log says so once.
    """
    if resumable():
        loop.set_task_factory(functools.partial(_task_factory, Nesting()))


@functools.cache
def resumable() -> bool:
    """Return whether streams can resume tasks at once here; limitations are logged."""
    if not works(None):
        Stream.use_futures()
        log.warning("%s: streams wait on futures, since its tasks accept nothing else", PYTHON)
    found = works(functools.partial(_task_factory, Nesting()))
    if not found:
        log.warning("%s: streams wake tasks through the loop, which is slower", PYTHON)
    return found


def works(factory: Factory | None) -> bool:
    """Return whether streams and tasks of a factory work together; `None` for asyncio's own."""
    return passes(asyncio.SelectorEventLoop, functools.partial(_exercise, factory))


async def _exercise(factory: Factory | None, loop: asyncio.AbstractEventLoop) -> bool:
    """Resume, suspend, cancel and fail readers of a stream, and return whether all went well."""
    me, at_once = asyncio.current_task(), factory is not None
    loop.set_task_factory(factory)
    numbers: Stream[int] = Stream("self-test")
    read: list[tuple[int, bool]] = []

    async def reader() -> None:
        own = asyncio.current_task()
        async for number in numbers:
            if number == 2:
                await asyncio.sleep(0)
            read.append((number, asyncio.current_task() is own))
            if number == 4:
                raise LookupError

    async def turns() -> None:
        for _ in range(4):
            await asyncio.sleep(0)

    failing = loop.create_task(reader())
    await turns()
    numbers.offer(1)
    good = (read == [(1, True)]) == at_once and asyncio.current_task() is me
    await turns()
    numbers.offer(2)  # which waits for the loop, so the task takes over
    numbers.offer(3)
    await turns()
    numbers.offer(4)
    await turns()
    good &= read == [(1, True), (2, True), (3, True), (4, True)] and failing.done()
    good &= isinstance(failing.exception(), LookupError)
    cancelled = loop.create_task(reader())
    await turns()
    cancelled.cancel()
    numbers.offer(5)  # kept for the next reader
    await turns()
    return good and cancelled.cancelled() and numbers.receive_nowait() == 5


class RunTask(asyncio.Task[Any]):
    """Task protectable by the run, hashed independently of its address.

    So code that goes through a set of tasks does so in the same order in equal runs.
    """

    tasks = 0
    """Tasks made by this task: a count of its own, unchanged by observers."""

    protected = False
    """Whether the task is protected: of all nodes, only the node of its name may cancel."""

    def __init__(self, number: int, coro: Coroutine[Any, Any, Any], **options: Any) -> None:
        self._number = number
        super().__init__(coro, **options)

    def __hash__(self) -> int:
        return self._number

    def cancel(self, msg: Any | None = None) -> bool:
        """Cancel the task; raise `NodeError` if it is protected from the node that asks."""
        caller = sys._getframe(1)
        if self.protected and not caller.f_globals.get("__name__", "").startswith("runtime."):
            node, place = code_location.of_thread(caller)
            if node not in {"runtime", self.get_name()}:
                error = NodeError(
                    node,
                    "expected it to cancel no tasks but its own, found it cancelling "
                    f"that of {self.get_name()}",
                )
                error.place = place
                raise error
        return super().cancel(msg)


def _task_factory(
    nesting: Nesting,
    loop: asyncio.AbstractEventLoop,
    coro: Coroutine[Any, Any, Any],
    context: contextvars.Context | None = None,
    **options: Any,
) -> asyncio.Task[Any]:
    """Make a task whose coroutine streams can step.

    A task that is given a context shares it, and a context cannot be entered twice; such a task
    stays a stock one, which streams wake through the loop.
    """
    if context is None:
        context = contextvars.copy_context()
        coro = ResumableCoroutine(coro, loop, context, nesting)
    parent: Any = tasks.current_tasks.get(loop)
    counter = parent if isinstance(parent, RunTask) else nesting
    counter.tasks += 1
    return RunTask(counter.tasks, coro, loop=loop, context=context, **options)


R = TypeVar("R")

GRACE = 1.0  # real seconds for tasks and asynchronous generators to end when the loop is closed

_MOST_ESCAPES = 100

LEFT: list[Any] = []
"""Tasks not ended in time. They are kept: thrown away, they would complain on standard error. A
process with any must end by `os._exit`.
"""


def run_to_end(
    loop: asyncio.AbstractEventLoop,
    main: Coroutine[Any, Any, R],
    escaped: Callable[[BaseException], None],
) -> R:
    """Run a loop until a coroutine is done, close the loop, and return the coroutine's result.

    Args:
        escaped: Called with errors of the loop while `main` is not done; the loop then goes on,
            unless this raises.
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
    task = loop.create_task(coro)
    task.add_done_callback(lambda _: loop.stop())
    timer = call_after(seconds, loop, loop.stop)
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
