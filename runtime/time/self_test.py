"""Trying once per process whether this interpreter's asyncio works as this project relies on.

What is tried, and what is done if it does not: `runtime.run.task_factory`, `runtime.time.lockstep`.
"""

from __future__ import annotations

import asyncio
import platform
import threading
from collections.abc import Callable, Coroutine
from typing import Any

LIMIT = 20.0
"""Real seconds after which a test that has not ended has failed; busy machines take their time."""

PYTHON = f"{platform.python_implementation()} {platform.python_version()}"


def passes(
    make_loop: Callable[[], asyncio.AbstractEventLoop],
    test: Callable[[asyncio.AbstractEventLoop], Coroutine[Any, Any, bool]],
) -> bool:
    """Return whether a test succeeds on a loop of its own, with nothing reported to that.

    It runs in a thread, because another loop may run in this one, and costs 3 ms.
    """
    found: list[bool] = []

    def run() -> None:
        reported: list[Any] = []
        try:
            loop = make_loop()
            loop.set_exception_handler(lambda _, context: reported.append(context))
            try:
                found.append(loop.run_until_complete(test(loop)) and not reported)
            finally:
                loop.close()
        except Exception:  # whatever another interpreter may raise
            found.append(False)

    thread = threading.Thread(target=run, name="self-test", daemon=True)
    thread.start()
    thread.join(LIMIT)
    return found == [True]
