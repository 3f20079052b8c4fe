"""Logging by the standard library through a queue: a slow terminal delays no node.

Levels: trace (5), debug, info, warning, error, and fatal, which also stops the run. Each node has
a logger, ``visnav.<node>``; lines carry the time of the run's clock.

Whatever is logged, a run ends: messages are cut, the queue is bounded, and a slow terminal is
given up soon after the end. Omissions are counted and logged.

Of runs in several threads of a process each logs its own lines only. A line is that of the run
whose node logs it, or in whose thread it is logged: its own, one of `executor`, or a `RunThread`.
Lines of other threads, such as a library's, are in the logs of all runs.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import copy
import logging
import logging.handlers
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from runtime.errors import FatalError

if TYPE_CHECKING:
    from rich.console import Console

TRACE = 5
LEVELS = {
    "trace": TRACE, "debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING,
    "error": logging.ERROR, "fatal": logging.CRITICAL,
}  # fmt: skip


LONGEST = 65_536  # characters of a message in ``log.txt``
LONGEST_SHOWN = 2_000  # characters of a message in the terminal

LONGEST_HIGHLIGHTED = 400
"""Most characters of a message in colour: the cost grows with the square of a word's length."""

MOST_WAITING = 64 << 20
"""Most characters of lines and their metadata waiting to be written; more are dropped."""

PATIENCE = 2.0  # real seconds for a terminal to show the waiting lines after the end of a run

_OF_RECORD = 300  # what a record takes besides its message, in characters

_HARMFUL = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"
} | {code: f"\\u{code:04x}" for code in (*range(0x2028, 0x202F), *range(0xD800, 0xE000))}


def harmless(text: str) -> str:
    """Return a text unable to steer a terminal or to imitate other lines of a log.

    It is cut to `LONGEST` characters and says so; escapes and the like become visible, and lines
    after the first begin with a bar.
    """
    if len(text) > LONGEST:
        text = f"{text[:LONGEST]}… ({len(text):,} characters)"
    return text.translate(_HARMFUL).replace("\n", "\n    | ")


class _OfThread(threading.local):
    run: object | None = None


_of_thread = _OfThread()


@contextlib.contextmanager
def lines_of(run: object | None) -> Iterator[None]:
    """Count the lines logged in this thread as those of a run while the block runs."""
    before, _of_thread.run = _of_thread.run, run
    try:
        yield
    finally:
        _of_thread.run = before


class RunThread(threading.Thread):
    """Thread of the run whose thread makes it: its lines are in that run's log."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._of_run = _of_thread.run

    def run(self) -> None:
        """Call the target; called by the thread."""
        with lines_of(self._of_run):
            super().run()


def executor(name: str, threads: int | None = None) -> concurrent.futures.ThreadPoolExecutor:
    """Return an executor for nodes' slow work, with threads of the run whose thread makes it."""
    run = _of_thread.run

    def adopt() -> None:
        _of_thread.run = run

    return concurrent.futures.ThreadPoolExecutor(
        threads, thread_name_prefix=name, initializer=adopt
    )


class NodeLogger(logging.LoggerAdapter[logging.Logger]):
    """A node's logger, of the run whose thread makes it."""

    def __init__(self, node: str) -> None:
        super().__init__(logging.getLogger(f"visnav.{node}"))
        self.node = node
        self._of_run = _of_thread.run

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, Any]:
        """Add the run to the record; the logger's name is the sender's."""
        kwargs["extra"] = {**(kwargs.get("extra") or {}), "of_run": self._of_run}
        return msg, kwargs

    def trace(self, msg: str, *args: object) -> None:
        """Log a message of use only for finding a bug."""
        self.log(TRACE, msg, *args)

    def fatal(self, msg: str, *args: object) -> NoReturn:
        """Log a message and end the run by a `FatalError`: the node cannot go on."""
        self.log(logging.CRITICAL, msg, *args, extra={"reported": True})  # as the run's error
        raise FatalError(self.node, msg % args if args else msg)


class _Queued(logging.handlers.QueueHandler):
    def __init__(self, records: queue.SimpleQueue[logging.LogRecord]) -> None:
        super().__init__(records)
        self.queued = self.handled = self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a record, or count a drop if there is no room; errors have extra room."""
        room = MOST_WAITING * (2 if record.levelno >= logging.ERROR else 1)
        if self.queued - self.handled > room:
            self.dropped += 1
            return
        self.queued += _size(record)
        super().enqueue(record)

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Format message and traceback while the described objects are unchanged."""
        record = copy.copy(record)
        text = record.getMessage()
        record.length = len(text)
        record.msg, record.args = harmless(text), None
        if record.exc_info:
            trace = logging.Formatter().formatException(record.exc_info)
            record.exc_text = harmless(trace).replace("\n    | ", "\n")
            record.exc_info = None
        return record


class _Listener(logging.handlers.QueueListener):
    """Hands queued records to the handlers; once the run is over, to a terminal not for long."""

    def __init__(
        self, queued: _Queued, records: queue.SimpleQueue[Any], handlers: list[logging.Handler]
    ) -> None:
        super().__init__(records, *handlers, respect_handler_level=True)
        self.ends = float("inf")
        self.unshown = 0
        self._queued = queued

    def handle(self, record: logging.LogRecord) -> None:
        """Pass a record to the handlers of its level; after `ends`, not to a terminal."""
        self._queued.handled += _size(record)
        late = time.monotonic() > self.ends
        for handler in self.handlers:
            if late and isinstance(handler.formatter, _OneLine):
                self.unshown += 1
            elif record.levelno >= handler.level:
                handler.handle(record)

    def say(self, text: str) -> None:
        """Warn of something at the very end."""
        self.ends = float("inf")
        self.handle(self._queued.prepare(self._record(text)))

    def _record(self, text: str) -> logging.LogRecord:
        fields = {"name": "visnav.runtime", "levelno": logging.WARNING, "levelname": "WARNING"}
        record = logging.makeLogRecord({**fields, "msg": text})
        for log_filter in self._queued.filters:
            log_filter(record)  # type: ignore[operator]
        return record


def _size(record: logging.LogRecord) -> int:
    return len(record.msg) + len(record.exc_text or "") + _OF_RECORD


class _OneLine(logging.Formatter):
    """Formatter without tracebacks and ends of long messages; these are in ``log.txt``."""

    def format(self, record: logging.LogRecord) -> str:
        record = copy.copy(record)
        record.exc_info = record.exc_text = None
        text, length = record.getMessage(), getattr(record, "length", 0)
        if len(text) > LONGEST_SHOWN:
            record.msg, record.args = f"{text[:LONGEST_SHOWN]}… ({length:,} characters)", None
        return super().format(record)


class _File(logging.FileHandler):
    """Handler writing records to a file as long as possible."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802, ARG002
        """Report the first failure to write, and write no more."""
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
        level: One of `LEVELS`, for nodes and runtime; libraries log warnings and worse.
        now: The run's clock (ns), read when a record is made.
    """
    logging.addLevelName(TRACE, "TRACE")
    run = _of_thread.run or object()
    records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    handler = _Queued(records)

    def stamp(record: logging.LogRecord) -> bool:
        if (getattr(record, "of_run", None) or _of_thread.run or run) is not run:
            return False
        if record.name.partition(".")[0] == "visnav" and record.levelno < LEVELS[level]:
            return False
        record.seconds = now() / 1e9
        record.logger_name = record.name.removeprefix("visnav.")
        return True

    handler.addFilter(stamp)
    listener = _Listener(handler, records, handlers)
    root = logging.getLogger()
    root.addHandler(handler)
    listener.start()
    try:
        with lines_of(run), _level(LEVELS[level]):
            yield
    finally:
        listener.ends = time.monotonic() + PATIENCE
        listener.stop()
        if handler.dropped:
            listener.say(f"{handler.dropped} log lines were dropped: they came too fast")
        if listener.unshown:
            listener.say(f"{listener.unshown} log lines are not shown here: they came too fast")
        root.removeHandler(handler)
        for target in handlers:
            target.close()


_levels: list[int] = []
_usual_level = logging.NOTSET  # while no run goes on
_changing_levels = threading.Lock()


@contextlib.contextmanager
def _level(level: int) -> Iterator[None]:
    """Have nodes and runtime log lines of a level; of several at a time, the lowest counts."""
    global _usual_level
    ours = logging.getLogger("visnav")
    with _changing_levels:
        if not _levels:
            _usual_level = ours.level
        _levels.append(level)
        ours.setLevel(min(_levels))
    try:
        yield
    finally:
        with _changing_levels:
            _levels.remove(level)
            ours.setLevel(min(_levels, default=_usual_level))


def terminal_handler(console: Console | None = None) -> logging.Handler:
    """Return a handler printing to standard error, in colour on a terminal.

    Left out are tracebacks, and what the command line says itself when the run is over (records
    with `reported`).
    """
    from rich.console import Console
    from rich.logging import RichHandler

    console = console or Console(stderr=True)
    handler = RichHandler(console=console, show_path=False, show_time=False, markup=False)
    handler.setFormatter(_OneLine("%(seconds)9.3f %(logger_name)s: %(message)s"))
    handler.addFilter(lambda record: not getattr(record, "reported", False))
    handler.addFilter(_without_colours_if_long)
    return handler


def _without_colours_if_long(record: logging.LogRecord) -> bool:
    if len(record.msg) > LONGEST_HIGHLIGHTED:
        record.highlighter = None
    return True


def file_handler(path: Path) -> logging.Handler:
    """Return a handler writing all records to a file."""
    handler = _File(path, mode="w", encoding="utf-8", delay=False)
    handler.setFormatter(
        logging.Formatter("%(seconds)12.6f %(levelname)-8s %(logger_name)s: %(message)s")
    )
    return handler
