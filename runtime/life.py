"""What belongs to one node while it runs, and how its errors are named and logged."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable
from typing import Any

from runtime.clock import Clock
from runtime.config import NodeSpec
from runtime.errors import NodeError, NodeTimeoutError, VisnavError
from runtime.limits import real_time_limit
from runtime.links import Link
from runtime.node import Node, streams
from runtime.schedule import Ticker
from runtime.worker import Worker

log = logging.getLogger("visnav.runtime")


class Life:
    """What belongs to one node while it runs."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self.node: Node[Any] | None = None
        self.tasks: set[asyncio.Task[None]] = set()
        self.tickers: list[Ticker] = []
        self.workers: list[Worker[Any]] = []
        self.links: dict[str, Link] = {}
        self.started = False
        self.failures = 0
        self.recovering = False
        self.ending = asyncio.Lock()

    def make_links(self, clock: Clock, seed: int) -> None:
        """Make the links that the file puts before the node's ports."""
        self.links = {
            port: Link(f"{self.spec.name}.{port}", config, clock, seed)
            for port, config in self.spec.links.items()
        }

    async def end(self, limit: float) -> list[NodeError]:
        """End ticks, tasks, node and workers; whatever goes wrong, the other steps follow.

        Args:
            limit: Real seconds that a step may take.

        Returns:
            What went wrong; it is logged.
        """
        node, wrong = self.node, []
        for ticker in self.tickers:
            ticker.stopped = True
        self.tickers.clear()
        for task in self.tasks:
            task.cancel()
        if self.tasks:
            wrong += await self._within(limit, "its tasks", asyncio.wait(self.tasks))
        if node is not None and self.started:
            wrong += await self._within(limit, "on_shutdown", node.on_shutdown())
        for worker in self.workers:
            await asyncio.to_thread(worker.close)
        self.workers.clear()
        self.started = False
        for link in self.links.values():
            link.close()
        if node is not None:
            for stream in streams(node).values():
                stream.close()
        return wrong

    async def _within(self, limit: float, what: str, ending: Awaitable[Any]) -> list[NodeError]:
        """Await a step of the end, and return what went wrong."""
        name = self.spec.name
        try:
            async with real_time_limit(limit):
                await ending
        except TimeoutError:
            late = NodeTimeoutError(name, f"expected {what} to end within {limit:g} s")
            log.error("%s", late)
            return [late]
        except Exception as error:
            log.error("%s: %s: %s", name, what, error, exc_info=error)
            return [wrap(name, error)]
        return []


def log_error(error: NodeError, *, last: bool) -> None:
    """Log a node's error, with the traceback of what is not an error of ours.

    An error of ours says all in its message; if it is the last thing that happens, the command
    line prints it, and the terminal need not have it twice.
    """
    cause = error.__cause__
    ours = isinstance(error if cause is None else cause, VisnavError)
    log.error("%s", error, exc_info=None if ours else cause, extra={"told": ours and last})


def wrap(name: str, error: Exception) -> NodeError:
    """Return a node's exception as an error that names the node."""
    ours = isinstance(error, VisnavError)  # says all there is to say; others need their type
    wrapped = NodeError(name, str(error) if ours else f"{type(error).__name__}: {error}")
    wrapped.__cause__ = error
    return wrapped
