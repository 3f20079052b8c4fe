"""Writing to a disk that may be full: in pieces that are there, or are not."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import shutil
from pathlib import Path
from typing import IO, Any

from runtime.errors import VisnavError


class RecordingError(VisnavError):
    """A recording cannot be written or read; the message names the file and says why."""


class WholeWrites(io.BufferedIOBase):
    """A file in which a piece is whole, or is not there: no half a chunk if the disk is full.

    A piece is all that is written until `flush`.

    Args:
        raw: The file, unbuffered, at its beginning.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        self._raw = raw
        self._piece: list[bytes | bytearray] = []
        self._at = 0
        self.size = 0
        """Bytes of whole pieces so far."""

    def write(self, data: Any) -> int:
        """Add to the piece; nothing is copied, so the bytes must not change."""
        self._piece.append(data)
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        """Return where the next bytes will stand."""
        return self._at

    def flush(self) -> None:
        """Write the piece.

        Raises:
            OSError: It could not be written, and nothing of it is in the file.
        """
        piece, self._piece = self._piece, []
        try:
            for data in piece:
                rest = memoryview(data)
                while len(rest):
                    rest = rest[self._raw.write(rest) or 0 :]
        except OSError:
            self._at = self.size
            with contextlib.suppress(OSError):  # no ordinary file
                self._raw.seek(self.size)
                self._raw.truncate(self.size)
            raise
        self.size = self._at

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._raw.fileno()

    def close(self) -> None:
        """Close the file, without what was not flushed."""
        self._raw.close()


def open_anew(path: Path) -> IO[bytes]:
    """Open a file to write it from its beginning, and keep others from doing so meanwhile.

    Raises:
        OSError: It cannot be opened, or somebody else is writing it.
    """
    file = open(  # noqa: SIM115
        path,
        "wb",
        buffering=0,
        opener=lambda name, flags: os.open(name, flags & ~os.O_TRUNC, 0o666),
    )
    if not _locked(file, fcntl.LOCK_EX):
        file.close()
        raise OSError("another process is writing it")
    with contextlib.suppress(OSError):  # no ordinary file
        file.truncate()
    return file


def is_being_written(file: IO[bytes]) -> bool:
    """Tell whether a process holds a file that it got from `open_anew`."""
    return not _locked(file, fcntl.LOCK_SH)


def unwritable(path: Path, error: OSError) -> RecordingError:
    """Return the error that says which file cannot be written, and how much room there is."""
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB free"
    except OSError:
        free = "free space unknown"
    return RecordingError(f"{path} cannot be written: {error.strerror or error} ({free})")


def _locked(file: IO[bytes], how: int) -> bool:
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
