"""Self-tests of the interpreter: whether its asyncio works as the runtime relies on."""

from __future__ import annotations

import asyncio
import platform
import threading
from collections.abc import Callable, Coroutine
from typing import Any

LIMIT = 20.0  # real seconds until an unfinished test has failed; busy machines take their time

PYTHON = f"{platform.python_implementation()} {platform.python_version()}"


def passes(
    make_loop: Callable[[], asyncio.AbstractEventLoop],
    test: Callable[[asyncio.AbstractEventLoop], Coroutine[Any, Any, bool]],
) -> bool:
    """Return whether a test succeeds on a new loop, with no exceptions reported.

    It runs in a thread, because another loop may run in this one, and costs 3 ms.
    """
    outcomes: list[bool] = []

    def run() -> None:
        reported: list[Any] = []
        try:
            loop = make_loop()
            loop.set_exception_handler(lambda _, context: reported.append(context))
            try:
                outcomes.append(loop.run_until_complete(test(loop)) and not reported)
            finally:
                loop.close()
        except Exception:  # whatever another interpreter may raise
            outcomes.append(False)

    thread = threading.Thread(target=run, name="self-test", daemon=True)
    thread.start()
    thread.join(LIMIT)
    return outcomes == [True]
