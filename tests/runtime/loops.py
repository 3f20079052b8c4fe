"""The loops and the two kinds of task on which everything that waits is tested."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

import uvloop

from runtime.run import event_loop as task_factory
from runtime.time.lockstep import LockstepLoop

R = TypeVar("R")

LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {
    "asyncio": asyncio.SelectorEventLoop,
    "uvloop": uvloop.new_event_loop,
    "lockstep": LockstepLoop,
}


@dataclass(frozen=True)
class Run:
    """Runs a coroutine to its end; nothing may go to the loop's exception handler meanwhile."""

    loop: str
    ours: bool

    def __call__(self, main: Coroutine[Any, Any, R]) -> R:
        reported: list[dict[str, Any]] = []

        async def prepared() -> R:
            loop = asyncio.get_running_loop()
            loop.set_exception_handler(lambda _, context: reported.append(context))
            if self.ours:
                task_factory.install(loop)
            return await loop.create_task(main)

        debug = self.loop == "asyncio"
        with asyncio.Runner(loop_factory=LOOPS[self.loop], debug=debug) as runner:
            result = runner.run(prepared())
        assert reported == []
        return result


async def turns(count: int = 3) -> None:
    """Let the loop turn; three turns are enough for any single wake-up."""
    for _ in range(count):
        await asyncio.sleep(0)
