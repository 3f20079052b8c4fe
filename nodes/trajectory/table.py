"""Text files of numbers in rows, common to all trajectory formats.

Files of a run grow with the run, so that a killed run lacks only its last second; those of before a
node's restart are never overwritten.
"""

from __future__ import annotations

import datetime as dt
import decimal
import math
import threading
from collections import deque
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NoReturn

from runtime import Node
from runtime.time.schedule import SECOND

_TOO_LATE = 1 << 63  # first number of nanoseconds beyond 64 bits
EPOCH = "2020-01-01T00:00:00Z"  # default start of a run in exported files: Unix time of 19 digits
_LATEST = 7 << 60  # latest epoch (ns), with room for a run of decades
_SHOWN = 60  # characters of a wrong line shown in a message


def epoch_of(given: int | str) -> int:
    """Return nanoseconds of Unix time (1970 to 2225), from such or ISO 8601, or `ValueError`."""
    expected = "expected nanoseconds of Unix time or a date as 2020-01-01T00:00:00Z"
    try:
        if isinstance(given, int) or given.isdecimal():
            epoch = int(given)
        else:
            date = dt.datetime.fromisoformat(given)
            if date.tzinfo is None:
                date = date.replace(tzinfo=dt.UTC)
            since = date - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
            epoch = since // dt.timedelta(microseconds=1) * 1000
    except (ValueError, OverflowError):
        raise ValueError(f"epoch: {expected}, found {given!r:.60}") from None
    if not 0 <= epoch <= _LATEST:
        raise ValueError(f"epoch: {expected}, from 1970 to 2225, found {given!r:.60}")
    return epoch


class Row:
    """A line of a file, split into fields; ``#`` starts a comment."""

    __slots__ = ("fields", "where")

    def __init__(self, where: str, fields: list[str]) -> None:
        self.where, self.fields = where, fields

    def numbers(self, start: int, end: int) -> list[float]:
        """Return fields as finite numbers; a `ValueError` if one is none."""
        try:
            values = [float(field) for field in self.fields[start:end]]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            self.wrong("finite numbers", " ".join(self.fields[start:end]))
        return values

    def seconds(self) -> int:
        """Return the first field (seconds) in exact whole nanoseconds, or raise a `ValueError`."""
        try:
            stamp = int((decimal.Decimal(self.fields[0]) * SECOND).to_integral_value())
        except (decimal.InvalidOperation, ValueError, OverflowError):
            stamp = _TOO_LATE
        if abs(stamp) >= _TOO_LATE:
            unit = "seconds, not in nanoseconds" if 1e23 < abs(stamp) < 1e28 else "seconds"
            self.wrong(f"a stamp in {unit}", self.fields[0])
        return stamp

    def nanoseconds(self) -> int:
        """Return the first field, a whole number; a `ValueError` if it is none."""
        try:
            stamp = int(self.fields[0])
        except ValueError:
            stamp = _TOO_LATE
        if abs(stamp) >= _TOO_LATE:
            self.wrong("a stamp in whole nanoseconds", self.fields[0])
        return stamp

    def wrong(self, expected: str, found: str) -> NoReturn:
        """Raise a `ValueError` with the file and the line."""
        shown = found if len(found) <= _SHOWN else f"{found[:_SHOWN]}…"
        raise ValueError(f"{self.where}: expected {expected}, found {shown!r}")


def read_rows(
    path: Path,
    separator: str | None,  # between fields; None for blanks
    columns: Collection[int],  # allowed numbers of fields
    meaning: str,
    *,
    whole: bool = True,  # whether a last line without its end counts
    header: bool = False,  # whether to skip a first line that begins with a letter
) -> Iterator[Row]:
    """Yield the rows of a file; a `ValueError` if unreadable, empty, or of another length."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected a text file of rows {meaning}, found: {error}"
        ) from None
    if not whole:
        text = text[: text.rfind("\n") + 1]
    empty = True
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content or (header and number == 1 and content[0].isalpha()):
            continue
        row = Row(f"{path}:{number}", [field.strip() for field in content.split(separator)])
        if len(row.fields) not in columns:
            counts = " or ".join(map(str, columns))
            row.wrong(f"{counts} fields ({meaning})", f"{len(row.fields)}: {content}")
        empty = False
        yield row
    if empty:
        raise ValueError(f"{path}: expected rows of {meaning}, found none")


def seconds_text(stamp: int) -> str:
    """Return nanoseconds as seconds with nine decimals, exactly."""
    whole, rest = divmod(abs(stamp), SECOND)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"


_INTERVAL = 500_000_000  # nanoseconds of the run's clock between two writes


def part_name(node: Node[Any], name: str) -> str:
    """Return the name of a node's file or folder; after a restart ``flight-2.png``, and so on."""
    path = Path(name)
    number = f"-{node.restarts + 1}" if node.restarts else ""
    return str(path.with_name(f"{path.stem}{number}{path.suffix}"))


class GrowingFile:
    """A file of lines (a restarted node's goes on): added on the loop, written beside it."""

    def __init__(self, node: Node[Any], path: Path, head: str = "") -> None:
        self._node = node
        self._file = path.open("ab" if node.restarts else "wb", buffering=0)
        self.begin = self._file.tell()  # bytes there before
        self._lines = deque([] if self.begin else [head])
        self._due = 0
        self._writing = False
        self._lock = threading.Lock()

    def add(self, line: str) -> None:
        """Add a line, with its end."""
        self._lines.append(line)
        now = self._node.clock.now()
        if now >= self._due and not self._writing:
            self._due, self._writing = now + _INTERVAL, True
            self._node.start(self._node.offload(self._write))

    def close(self) -> None:
        """Write the remaining lines, and close the file."""
        try:
            self._write()
        finally:
            self._file.close()

    def _write(self) -> None:
        with self._lock:  # the run's end does not wait for a write that it cancels
            if not self._file.closed:
                lines = [self._lines.popleft() for _ in range(len(self._lines))]
                rest = memoryview("".join(lines).encode("ascii"))
                while rest:
                    rest = rest[self._file.write(rest) :]
        self._writing = False
