"""What a process prints, and how its end is told."""

from __future__ import annotations

import collections
import signal
from collections.abc import Callable

_LONGEST = 4096
"""Bytes of a line; a longer one is cut into several."""

_KEPT = 20
"""Lines that are told of a process that has ended."""


class Output:
    """The lines that a process prints, and the last of them for the story of its end.

    Args:
        printed: Called with each line, without its end.
    """

    def __init__(self, printed: Callable[[str], None]) -> None:
        self._printed = printed
        self._begun = b""
        self._last: collections.deque[str] = collections.deque(maxlen=_KEPT)

    def take(self, data: bytes) -> None:
        """Take what was read."""
        *lines, begun = (self._begun + data).split(b"\n")
        while len(begun) > _LONGEST:
            lines.append(begun[:_LONGEST])
            begun = begun[_LONGEST:]
        self._begun = begun
        for line in lines:
            self._take_line(line)

    def end(self) -> None:
        """Take what stands after the last end of a line."""
        if self._begun:
            self._take_line(self._begun)
            self._begun = b""

    def story(self, what: str) -> str:
        """Return what became of the process, and its last lines."""
        if not self._last:
            return f"{what}; it said nothing"
        return f"{what}; its last output:\n" + "\n".join(self._last)

    def _take_line(self, line: bytes) -> None:
        text = line.decode(errors="replace").rstrip()
        self._last.append(text)
        self._printed(text)


def how_it_ended(code: int) -> str:
    """Return an exit code in words; one below 0 is the signal that killed the process."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"killed by signal {-code} ({signal.strsignal(-code) or 'unknown'})"
