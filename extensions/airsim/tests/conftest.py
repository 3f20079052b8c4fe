"""A world that is quick to build."""

from __future__ import annotations

import pytest

from tests.sims.vehicle.flight import WORLD


@pytest.fixture(scope="session")
def tiny_world(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the path of a world with a floor and little else."""
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    return str(path)
