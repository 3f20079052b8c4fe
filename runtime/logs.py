"""Logging: the standard library's, through a queue, so that a slow terminal delays no node.

Levels: trace (5), debug, info, warning, error, and fatal, which also stops the run. Each node has
a logger, ``visnav.<node>``; lines carry the time of the run's clock.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import logging.handlers
import queue
import sys
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from runtime.errors import FatalError

if TYPE_CHECKING:
    from rich.console import Console

TRACE = 5
LEVELS = {
    "trace": TRACE,
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}


class NodeLogger(logging.LoggerAdapter[logging.Logger]):
    """A node's logger."""

    def __init__(self, node: str) -> None:
        super().__init__(logging.getLogger(f"visnav.{node}"))
        self.node = node

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, Any]:
        """Add nothing to the message; the logger's name is the sender's."""
        return msg, kwargs

    def trace(self, msg: str, *args: object) -> None:
        """Log what helps only to find a bug."""
        self.log(TRACE, msg, *args)

    def fatal(self, msg: str, *args: object) -> NoReturn:
        """Log, and end the run: it cannot go on.

        Raises:
            FatalError: Always.
        """
        self.log(logging.CRITICAL, msg, *args, extra={"reported": True})  # as the run's error
        raise FatalError(self.node, msg % args if args else msg)


class _Queued(logging.handlers.QueueHandler):
    """Queues records; their tracebacks stay apart from their messages."""

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Make message and traceback while what they describe is as it is."""
        record = copy.copy(record)
        record.msg, record.args = record.getMessage(), None
        if record.exc_info:
            record.exc_text = logging.Formatter().formatException(record.exc_info)
            record.exc_info = None
        return record


class _OneLine(logging.Formatter):
    """Leaves out tracebacks, which are for ``log.txt``."""

    def format(self, record: logging.LogRecord) -> str:
        record = copy.copy(record)
        record.exc_info = record.exc_text = None
        return super().format(record)


class _File(logging.FileHandler):
    """Writes records to a file as long as that is possible."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802, ARG002
        """Report once why it is not possible (any more)."""
        error = sys.exc_info()[1]
        self.setLevel(logging.CRITICAL + 1)
        stream, self.stream = self.stream, None
        with contextlib.suppress(Exception):  # what it still holds would fail again
            if stream is not None:
                stream.close()
        what = getattr(error, "strerror", None) or error
        print(f"warning: {self.baseFilename}: cannot be written: {what}", file=sys.stderr)


@contextlib.contextmanager
def logging_to(
    handlers: list[logging.Handler], level: str, now: Callable[[], int]
) -> Iterator[None]:
    """Send all log records through a queue to `handlers` while the block runs.

    Args:
        handlers: Where records end up; they run in a thread of their own.
        level: One of `LEVELS`, for nodes and runtime; libraries log warnings and worse.
        now: The run's clock (ns), read when a record is made.
    """
    logging.addLevelName(TRACE, "TRACE")
    records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    handler = _Queued(records)

    def stamp(record: logging.LogRecord) -> bool:
        record.seconds = now() / 1e9
        record.logger_name = record.name.removeprefix("visnav.")
        return True

    handler.addFilter(stamp)
    listener = logging.handlers.QueueListener(records, *handlers, respect_handler_level=True)
    root, ours = logging.getLogger(), logging.getLogger("visnav")
    before = ours.level
    root.addHandler(handler)
    ours.setLevel(LEVELS[level])
    listener.start()
    try:
        yield
    finally:
        listener.stop()
        ours.setLevel(before)
        root.removeHandler(handler)
        for each in handlers:
            each.close()


def terminal_handler(console: Console | None = None) -> logging.Handler:
    """Return a handler that prints to standard error, in colour where that is a terminal.

    A console may be given that other things are drawn on, too, such as a progress bar.

    It leaves out tracebacks, and what the command line says itself when the run is over (records
    with `reported`).
    """
    from rich.console import Console
    from rich.logging import RichHandler

    console = console or Console(stderr=True)
    handler = RichHandler(console=console, show_path=False, show_time=False, markup=False)
    handler.setFormatter(_OneLine("%(seconds)9.3f %(logger_name)s: %(message)s"))
    handler.addFilter(lambda record: not getattr(record, "reported", False))
    return handler


def file_handler(path: Path) -> logging.Handler:
    """Return a handler that writes everything to a file."""
    handler = _File(path, mode="w", encoding="utf-8", delay=False)
    handler.setFormatter(
        logging.Formatter("%(seconds)12.6f %(levelname)-8s %(logger_name)s: %(message)s")
    )
    return handler
