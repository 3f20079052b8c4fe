"""Fixtures of the tests of MAVLink's endpoint."""

from __future__ import annotations

from typing import Any

import pytest

from extensions.mavlink.tests.outside import Outside


@pytest.fixture
async def outside() -> Any:
    made = Outside()
    yield made
    made.close()
