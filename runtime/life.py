"""What belongs to one node while it runs, and how its errors are named and logged."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

from runtime.clock import Clock
from runtime.config import NodeSpec
from runtime.errors import NodeError, VisnavError
from runtime.links import Link
from runtime.node import Node
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

    def close_links(self) -> None:
        """Let nothing that is on its way arrive any more."""
        for link in self.links.values():
            link.close()


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
