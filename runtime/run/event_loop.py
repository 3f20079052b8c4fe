"""Event loops that run until a coroutine ends, and the places in code at which they stand.

A place is the node and line of a thread, a task or an exception. Not here: watching over a loop or
a run (`runtime.run.watchdogs`).

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
import gc
import logging
import sys
import threading
from collections.abc import Callable, Coroutine, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from runtime.channels import tasks
from runtime.channels.streams import Stream
from runtime.channels.tasks import Nesting, ResumableCoroutine
from runtime.errors import NodeError, UnraisableError
from runtime.interpreter import PYTHON, passes
from runtime.node import Node
from runtime.time.real_time import call_after

log = logging.getLogger("visnav.runtime")

Factory = Callable[..., asyncio.Task[Any]]


def install(loop: asyncio.AbstractEventLoop) -> None:
    """Make every task created on `loop` from now on resumable by streams.

    If the interpreter does not allow it, tasks stay asyncio's own, with one warning in the log.
    """
    if resumable():
        loop.set_task_factory(functools.partial(_task_factory, Nesting()))


@functools.cache
def resumable() -> bool:
    """Return whether streams can resume tasks at once here; limitations are logged."""
    if not works(None):
        Stream.use_futures()
        log.warning("%s: streams wait on futures, since its tasks accept nothing else", PYTHON)
    supported = works(functools.partial(_task_factory, Nesting()))
    if not supported:
        log.warning("%s: streams wake tasks through the loop, which is slower", PYTHON)
    return supported


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
        task = asyncio.current_task()
        async for number in numbers:
            if number == 2:
                await asyncio.sleep(0)
            read.append((number, asyncio.current_task() is task))
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
            node, place = of_thread(caller)
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


def line(frame: FrameType, number: int | None = None) -> str:
    """Return ``file:line in function``, the file with its whole path."""
    return f"{frame.f_code.co_filename}:{number or frame.f_lineno} in {frame.f_code.co_name}"


def short(place: str) -> str:
    """Return a place with no more of the file's path than its folder."""
    file, colon, rest = place.partition(":")
    return "/".join(Path(file).parts[-2:]) + colon + rest


def of_thread(frame: FrameType | None) -> tuple[str, str]:
    """Return the node and its line where a thread is; else ``runtime`` and its line."""
    frames = []
    while frame is not None:
        frames.append((frame, frame.f_lineno))
        frame = frame.f_back
    return _innermost(frames)


def of_task(task: asyncio.Task[Any]) -> tuple[str, str]:
    """Return the node and its line where a task waits; else ``runtime`` and a line."""
    return _innermost(list(_awaiting(task))[::-1])


def ready_on(loop: asyncio.AbstractEventLoop) -> list[tuple[str, str]]:
    """Return node and line of each task ready to go on in a loop of asyncio's own."""
    callbacks = [handle._callback for handle in list(loop._ready)]  # type: ignore[attr-defined]
    owners = [getattr(callback, "__self__", None) for callback in callbacks]
    return [of_task(owner) for owner in owners if isinstance(owner, asyncio.Task)]


def of_error(error: BaseException) -> tuple[str, str]:
    """Return the node and its line where an exception was raised; else ``runtime`` and a line."""
    frames = []
    trace = leaf(error).__traceback__
    while trace is not None:
        frames.append((trace.tb_frame, trace.tb_lineno))
        trace = trace.tb_next
    return _innermost(frames[::-1])


def leaf(error: BaseException) -> BaseException:
    """Return the only exception of a group, however nested, and the cause of an `UnraisableError`.

    Any other is returned as given.
    """
    while True:
        if isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:
            error = error.exceptions[0]
        elif isinstance(error, UnraisableError) and error.__cause__ is not None:
            error = error.__cause__
        else:
            return error


def waits_for(task: asyncio.Task[Any], future: asyncio.Future[Any]) -> bool:
    """Return whether a task waits for this future."""
    return getattr(task, "_fut_waiter", None) is future


def _awaiting(task: asyncio.Task[Any]) -> Iterator[tuple[FrameType, int]]:
    """Yield the frames of a task's coroutine and its awaited coroutines, outermost first."""
    coro: Any = task.get_coro()
    while coro is not None:
        for kind in ("cr", "gi", "ag"):
            if (frame := getattr(coro, f"{kind}_frame", None)) is not None:
                yield frame, frame.f_lineno
                coro = getattr(coro, "gi_yieldfrom" if kind == "gi" else f"{kind}_await", None)
                break
        else:
            return


def _innermost(frames: Iterable[tuple[FrameType, int]]) -> tuple[str, str]:
    """Return node and line of the first frame in a node's own code; else of the first frame."""
    innermost = "?"
    for frame, number in frames:
        if innermost == "?":
            innermost = line(frame, number)
        owner = frame.f_locals.get("self") if "self" in frame.f_code.co_varnames else None
        if isinstance(owner, Node) and not frame.f_code.co_filename.endswith("runtime/node.py"):
            return owner.name, line(frame, number)
    return "runtime", innermost


_one_at_a_time = threading.Lock()


def frame_of(thread_id: int) -> FrameType | None:
    """Return the current frame of a thread; `None` if there is no such thread.

    Up to Python 3.11, `sys._current_frames` collects garbage while it holds a lock that every
    thread takes as it starts and ends; if a finalizer gives up the GIL then, the process stands
    still for ever (https://github.com/python/cpython/issues/106883). So nothing is collected.
    """
    if sys.version_info >= (3, 12):
        return sys._current_frames().get(thread_id)
    with _one_at_a_time:
        collects = gc.isenabled()
        gc.disable()
        try:
            return sys._current_frames().get(thread_id)
        finally:
            if collects:
                gc.enable()
