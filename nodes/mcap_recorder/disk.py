"""Writing to a disk that may be full: in pieces that are there, or are not."""

from __future__ import annotations

import contextlib
import io
import shutil
from pathlib import Path
from typing import Any

from runtime.errors import VisnavError


class RecordingError(VisnavError):
    """A recording cannot be written or read; the message names the file and says why."""


class WholeWrites(io.BufferedIOBase):
    """A file in which a piece is whole, or is not there: no half a chunk if the disk is full.

    Args:
        raw: The file, unbuffered, at its beginning.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        self._raw = raw
        self.size = 0
        """Bytes so far."""

    def write(self, data: Any) -> int:
        """Write a piece.

        Raises:
            OSError: It could not be written, and nothing of it is in the file.
        """
        view = memoryview(data)
        rest = view
        try:
            while len(rest):
                rest = rest[self._raw.write(rest) or 0 :]
        except OSError:
            with contextlib.suppress(OSError):  # no ordinary file
                self._raw.seek(self.size)
                self._raw.truncate(self.size)
            raise
        self.size += len(view)
        return len(view)

    def tell(self) -> int:
        """Return where the next piece begins."""
        return self.size

    def flush(self) -> None:
        """Do nothing: nothing is kept back."""

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._raw.fileno()

    def close(self) -> None:
        """Close the file."""
        self._raw.close()


def unwritable(path: Path, error: OSError) -> RecordingError:
    """Return the error that says which file cannot be written, and how much room there is."""
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB free"
    except OSError:
        free = "free space unknown"
    return RecordingError(f"{path} cannot be written: {error.strerror or error} ({free})")
