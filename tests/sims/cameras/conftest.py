"""Both renderers in turn, for the tests that all renderers must pass."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sims.cameras.stage import RendererName
from tests.sims.cameras import scenes


@pytest.fixture(params=["raster", pytest.param("mujoco", marks=pytest.mark.slow)], scope="module")
def draws(request: pytest.FixtureRequest) -> Iterator[RendererName]:
    """Name of what draws, in all that `renderer_of` makes."""
    before, scenes.draws = scenes.draws, request.param
    yield request.param
    scenes.draws = before
