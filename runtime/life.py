"""What belongs to one node while it runs, and how its errors are named and logged."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Iterable
from typing import Any

from events import Announcement
from runtime.config import NodeSpec
from runtime.errors import NodeError, NodeTimeoutError, RefusedError, VisnavError
from runtime.limits import real_time_limit
from runtime.links import Link
from runtime.node import Host, Node, make_node, streams
from runtime.plain import plain
from runtime.schedule import Ticker
from runtime.worker import Worker

log = logging.getLogger("visnav.runtime")


class Life:
    """What belongs to one node while it runs."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec = spec
        self.node: Node[Any] | None = None
        self.tasks: dict[asyncio.Task[None], None] = {}  # in the order in which they were made
        self.tickers: list[Ticker] = []
        self.workers: list[Worker[Any]] = []
        self.links: dict[str, Link] = {}
        self.started = False
        self.starts = 0
        self.failures = 0
        self.recovering = False
        self.ending = asyncio.Lock()

    async def begin(self, host: Host, limit: float) -> None:
        """Make the node and the links before its ports, and start it up.

        Args:
            host: What the run does for it.
            limit: Real seconds that `on_startup` may take.

        Raises:
            NodeError: Something went wrong in it.
        """
        spec = self.spec
        try:
            self.node = make_node(spec.node, spec.name, spec.config, host, spec.inputs, self.starts)
            self.links = {
                port: Link(
                    f"{spec.name}.{port}", config, host.clock, host.seed, self.links.get(port)
                )
                for port, config in spec.links.items()
            }
            async with real_time_limit(limit):
                await self.node.on_startup()
            self.started = True
            self.starts += 1
        except NodeError:
            raise
        except TimeoutError:
            expected = f"expected on_startup to end within {limit:g} s"
            raise NodeTimeoutError(spec.name, f"{expected}, found it still running") from None
        except Exception as error:
            raise wrap(spec.name, error) from error

    def announced(self) -> list[Announcement]:
        """Return what the node announces.

        Raises:
            NodeError: Something went wrong in it, or it returns something else.
        """
        assert self.node is not None
        name = self.spec.name
        try:
            said: Any = self.node.announce()
            found: list[Any] = list(said) if isinstance(said, Iterable) else [said]
            for each in found:
                if not isinstance(each, Announcement):
                    raise NodeError(
                        name,
                        "announce(): expected announcements, "
                        f"found {each!r:.80} ({type(each).__name__})",
                    )
                plain(each, f"announce(): {type(each).__name__}")
            return found
        except NodeError:
            raise
        except Exception as error:
            raise wrap(name, error) from error

    def hear(self, announcements: Iterable[Announcement]) -> None:
        """Let the node hear all announcements.

        Raises:
            NodeError: Something went wrong in it; a `RefusedError` if it cannot work with one.
        """
        assert self.node is not None
        name = self.spec.name
        for announcement in announcements:
            try:
                self.node.on_announcement(announcement)
            except ValueError as error:
                what = f"cannot work with {announcement.source}: {error}"
                raise RefusedError(name, what) from error
            except NodeError:
                raise
            except Exception as error:
                raise wrap(name, error) from error

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
            wrapped = wrap(name, error)
            trace = None if isinstance(error, VisnavError) else error
            log.error("%s (%s)", wrapped, what, exc_info=trace)
            return [wrapped]
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
    text = str(error).removeprefix(f"{name}: ") if ours else f"{type(error).__name__}: {error}"
    wrapped = NodeError(name, text)
    wrapped.__cause__ = error
    return wrapped
