"""Text files that grow by a row at a time, in order of time."""

from __future__ import annotations

from pathlib import Path


class RowFile:
    """A text file of rows with rising stamps.

    Args:
        path: The file; made anew.
        header: Its first lines, each with its end.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, path: Path, header: str) -> None:
        self.path = path
        self.count = 0
        """Rows so far."""
        self.left_out = 0
        """Rows that came with a stamp not above the last one: readers expect them to rise."""
        self._last: int | None = None
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._file.write(header)

    def add(self, stamp: int, row: str) -> bool:
        """Add a row, which ends its own line; tell whether it was in order and is in."""
        if self._last is not None and stamp <= self._last:
            self.left_out += 1
            return False
        self._last = stamp
        self.count += 1
        self._file.write(row)
        return True

    def close(self) -> None:
        """Write out what is left."""
        self._file.close()
