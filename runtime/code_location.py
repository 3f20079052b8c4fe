"""Locations in code: the node and line of a thread, a task or an exception.

Not here: watching over a loop or a run (`runtime.run.watchdogs`).
"""

from __future__ import annotations

import asyncio
import gc
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from runtime.node import Node


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
    """Return the only exception of a group, however nested; any other as given."""
    while isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:
        error = error.exceptions[0]
    return error


def waits_for(task: asyncio.Task[Any], future: asyncio.Future[Any]) -> bool:
    """Tell whether a task waits for this future."""
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
