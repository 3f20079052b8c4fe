"""A folder for sockets that is short enough, and nobody else's."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Have runs listen in a folder of this test's, and return it."""
    with tempfile.TemporaryDirectory() as folder:  # pytest's own paths are too long for sockets
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder) / "visnav"
