"""Files that a mesh is read from, known to whoever keeps what was made of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_RECORD: ContextVar[list[Path] | None] = ContextVar("files of a mesh", default=None)


@contextmanager
def recorded() -> Iterator[list[Path]]:
    """Yield a list to which the paths of all files are added that are read meanwhile."""
    paths: list[Path] = []
    token = _RECORD.set(paths)
    try:
        yield paths
    finally:
        _RECORD.reset(token)


def content(path: Path) -> bytes:
    """Return a file's content; `OSError` if it cannot be read."""
    if (paths := _RECORD.get()) is not None and path not in paths:
        paths.append(path)
    return path.read_bytes()
