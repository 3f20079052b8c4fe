"""Fixture `visnav` for pytest, found by its entry point in every project that has us installed.

It is a module of its own, and light, since each pytest in the same environment imports it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from visnav import Run


class Runner:
    """Runs in folders of the test; see `visnav` itself for all else."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._count = 0

    def run(self, config: str | Path | Mapping[str, Any], **options: Any) -> Run:
        """Run a configuration as `visnav.run` does, quietly, with results in ``tmp_path``."""
        import visnav

        self._count += 1
        options = {"out": self._folder / f"run{self._count}", "quiet": True, **options}
        return visnav.run(config, **options)


@pytest.fixture
def visnav(tmp_path: Path) -> Runner:
    """Return what runs in the test's folder: ``assert visnav.run("config.toml").passed``."""
    return Runner(tmp_path)
