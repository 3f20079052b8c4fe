"""The benchmark of an odometry outside holds two flights that say the same against each other."""

from __future__ import annotations

import pytest

from bench.held import measure


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_both_sides_fly_the_same() -> None:
    (row,) = measure(seconds=2.0, repeats=1)
    assert row.equal
    assert row.ratio == pytest.approx(row.outside_speed / row.worker_speed)
