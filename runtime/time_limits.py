"""Limits in real time, which hold on a simulated clock too.

`asyncio.timeout` on a lockstep loop is simulated: where nothing else is due, it is over at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Iterable
from typing import Any


@contextlib.asynccontextmanager
async def real_time_limit(seconds: float) -> AsyncIterator[None]:
    """Cancel the block and raise `TimeoutError` if it takes more than `seconds` of real time."""
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    assert task is not None
    cancelled_before = task.cancelling()
    expired = cancelled = False

    def expire() -> None:
        nonlocal expired
        if not over:
            expired = True
            task.cancel()

    def ring() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            loop.call_soon_threadsafe(expire)

    over = False
    timer = threading.Timer(seconds, ring)
    timer.daemon = True
    timer.start()
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


async def ended(tasks: Iterable[asyncio.Task[Any]], seconds: float) -> list[asyncio.Task[Any]]:
    """Wait for so many real seconds at most until all tasks have ended.

    Returns:
        Those that have not.
    """
    tasks = [task for task in tasks if not task.done()]
    if tasks:
        with contextlib.suppress(TimeoutError):
            async with real_time_limit(seconds):
                await asyncio.wait(tasks)
    return [task for task in tasks if not task.done()]
