"""Another process's output and end: lines, bounded and without control codes, and reasons."""

from __future__ import annotations

import collections
import contextlib
import pickle
import re
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

_LONGEST = 4096  # bytes of a line at most; a longer line is cut into several
_REPORTED = 20  # last lines reported of an ended process
LINES = 100  # lines handed on per real second of a process; lines beyond are only counted

# A lone carriage return, as of a progress bar, ends a line, too; the next byte may be its "\n".
_LINE_END = re.compile(rb"\r?\n|\r(?!\Z)")

_ESCAPES = re.compile(
    r"\x1b\[[0-?]*[ -/]*[@-~]"  # colours, moves of the cursor
    r"|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?"  # titles
    r"|\x1b[ -/]*[0-~]?|[^\t\x20-\x7e\xa0-\U0010ffff]"  # all else that controls
)


def plain_lines(data: bytes | bytearray) -> Iterable[str]:
    """Yield another process's text in bounded lines, without terminal control codes."""
    for line in _LINE_END.split(data.removesuffix(b"\r")):
        for begin in range(0, max(len(line), 1), _LONGEST):
            text = line[begin : begin + _LONGEST].decode(errors="replace")
            if text.isprintable():
                yield text.rstrip()
                continue
            yield " ".join(_ESCAPES.sub("", text).splitlines()).rstrip()


class Throttle:
    """Prints lines from any thread, `LINES` a second at most, and the number of the rest."""

    def __init__(
        self, printed: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._printed, self._now = printed, now
        self._lock = threading.Lock()
        self._second, self._shown = 0, 0

    def __call__(self, line: str) -> None:
        """Print a line, unless there were too many within a second."""
        with self._lock:
            if (second := int(self._now())) != self._second:
                self._print_omitted()
                self._second, self._shown = second, 0
            self._shown += 1
            if self._shown <= LINES:
                self._printed(line)

    def add(self, text: bytes | bytearray) -> None:
        """Print the lines of a text; beyond the limit only count them, at little cost."""
        with self._lock:
            if self._shown > LINES and int(self._now()) == self._second:
                self._shown += text.count(b"\n") + 1
                return
        for line in plain_lines(text):
            self(line)

    def end(self) -> None:
        """Print how many lines were left out at last."""
        with self._lock:
            self._print_omitted()
            self._shown = 0

    def _print_omitted(self) -> None:
        if self._shown > LINES:
            self._printed(f"({self._shown - LINES} more lines)")


class Output:
    """Lines printed by a process, without their ends; the last are for a report."""

    def __init__(self, printed: Callable[[str], None]) -> None:
        self._printed = printed
        self._begun = b""
        self._last: collections.deque[str] = collections.deque(maxlen=_REPORTED)

    def add(self, data: bytes) -> None:
        """Add bytes read from the process."""
        *lines, begun = _LINE_END.split(self._begun + data)
        while len(begun.removesuffix(b"\r")) > _LONGEST:
            lines.append(begun[:_LONGEST])
            begun = begun[_LONGEST:]
        self._begun = begun
        for line in lines:
            self._add_line(line)

    def end(self) -> None:
        """Add the unfinished last line."""
        if self._begun:
            self._add_line(self._begun)
            self._begun = b""

    def story(self, what: str) -> str:
        """Return the report of the process's end, with its last lines."""
        if not self._last:
            return f"{what}; it said nothing"
        return f"{what}; its last output:\n" + "\n".join(self._last)

    def _add_line(self, line: bytes) -> None:
        for text in plain_lines(line):
            self._last.append(text)
            self._printed(text)


def how_it_ended(code: int) -> str:
    """Return an exit code in words; a negative code is the signal of the kill."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"killed by signal {-code} ({signal.strsignal(-code) or 'unknown'})"


class PortableError(NamedTuple):
    """An exception on its way to another process, which may be unable to make it again."""

    pickled: bytes  # empty if it cannot be pickled
    text: str  # type and message
    note: str  # its traceback, since tracebacks cannot be pickled
    place: str  # line of the worker's own code

    @classmethod
    def of(cls, error: BaseException, place: str) -> PortableError:
        """Return an exception raised in this process, whatever its methods do."""
        pickled, text = b"", f"{type(error).__name__}: a message that cannot be made"
        with contextlib.suppress(Exception):
            text = f"{type(error).__name__}: {error}"
        try:
            pickled = pickle.dumps(error)
        except BaseException:
            pickled = b""
        note = "in the worker:\n" + "".join(traceback.format_exception(error))
        return cls(pickled, text, note, place)

    def restored(self) -> BaseException:
        """Return the exception; a `RuntimeError` with its text if it cannot be made again."""
        error: Any = None
        try:
            error = pickle.loads(self.pickled) if self.pickled else None  # noqa: S301  # of our child
        except BaseException:
            error = None
        if not isinstance(error, BaseException):
            error = RuntimeError(self.text)
        with contextlib.suppress(Exception):  # of an odd class
            error.add_note(self.note)
            vars(error)["place_in_worker"] = self.place
        restored: BaseException = error
        return restored
