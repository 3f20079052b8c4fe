"""Limits in real time on any loop; `asyncio.timeout` on a lockstep loop is simulated."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable
from pathlib import Path
from typing import Any

LOOK_EVERY = 1.0  # real seconds between two looks at how busy the machine is


def call_after(
    seconds: float, loop: asyncio.AbstractEventLoop, call: Callable[[], object]
) -> threading.Timer:
    """Call a function on a loop, unless closed, after real seconds; return the running timer."""

    def submit() -> None:
        with contextlib.suppress(RuntimeError):  # closed
            loop.call_soon_threadsafe(call)

    timer = threading.Timer(seconds, submit)
    timer.daemon = True
    timer.start()
    return timer


@contextlib.asynccontextmanager
async def real_time_limit(seconds: float) -> AsyncIterator[None]:
    """Cancel the block and raise `TimeoutError` after `seconds` of real time."""
    task = asyncio.current_task()
    assert task is not None
    cancelled_before = task.cancelling()
    expired = cancelled = False

    def expire() -> None:
        nonlocal expired
        if not over:
            expired = True
            task.cancel()

    over = False
    timer = call_after(seconds, asyncio.get_running_loop(), expire)
    try:
        yield
    except asyncio.CancelledError:
        cancelled = True
        raise
    finally:
        over = True
        timer.cancel()
        if expired and task.uncancel() <= cancelled_before and cancelled:
            raise TimeoutError from None


class Starvation:
    """Real seconds that a process or its descendants waited for a processor, from the first look.

    On a busy machine that is most of the time, and no fault of whoever has a limit. It is 0 where
    the kernel does not tell.
    """

    def __init__(self, process: int | None = None) -> None:
        self._process = os.getpid() if process is None else process
        self._waits: dict[str, int] | None = None
        self._at = 0.0
        self._seconds = 0.0

    def look(self) -> float:
        """Return the seconds; between two looks, those of the longest waiting thread."""
        now, waits, before = time.monotonic(), waits_of(self._process), self._waits
        if before is not None:
            longest = max((wait - before.get(key, 0) for key, wait in waits.items()), default=0)
            self._seconds += min(longest / 1e9, now - self._at)
        self._at, self._waits = now, waits
        return self._seconds


def waits_of(process: int) -> dict[str, int]:
    """Return how long each thread of a process and of its children has waited to run (ns)."""
    waits, processes = {}, [process]
    for number in processes:
        threads: list[Path] = []
        with contextlib.suppress(OSError):  # it has ended
            threads += Path(f"/proc/{number}/task").iterdir()
        for thread in threads:
            with contextlib.suppress(OSError, IndexError):  # it has ended, or the kernel is another
                waits[thread.name] = int((thread / "schedstat").read_bytes().split()[1])
                processes += map(int, (thread / "children").read_bytes().split())
    return waits


async def ended(tasks: Iterable[asyncio.Task[Any]], seconds: float) -> list[asyncio.Task[Any]]:
    """Wait for tasks to end, so many real seconds without `Starvation`; return late ones."""
    tasks = [task for task in tasks if not task.done()]
    begin, starvation, left = time.monotonic(), Starvation(), seconds
    while tasks:
        with contextlib.suppress(TimeoutError):
            async with real_time_limit(min(left, LOOK_EVERY)):
                await asyncio.wait(tasks)
        tasks = [task for task in tasks if not task.done()]
        left = seconds - (time.monotonic() - begin)
        if tasks and seconds > LOOK_EVERY:
            left += starvation.look()
        if left <= 0:
            break
    return tasks
