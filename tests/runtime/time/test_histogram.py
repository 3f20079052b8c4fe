"""The histogram of lateness: as good as numpy's quantiles to within its buckets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.time.clock import DurationHistogram

durations = st.lists(st.integers(0, 10**12) | st.integers(0, 200), min_size=1, max_size=200)


def counted(values: list[int]) -> DurationHistogram:
    lateness = DurationHistogram()
    for value in values:
        lateness.add(value)
    return lateness


@pytest.mark.slow
@given(values=durations, q=st.sampled_from([0.25, 0.5, 0.75, 0.875, 1.0]))
def test_quantiles_are_numpys_to_within_a_bucket_and_never_too_low(
    values: list[int], q: float
) -> None:
    exact = int(np.quantile(values, q, method="inverted_cdf"))
    assert exact <= counted(values).quantile(q) <= exact * (1 + 1 / 32)


@given(values=durations, q=st.floats(0.0, 1.0))
def test_no_quantile_is_above_the_maximum(values: list[int], q: float) -> None:
    lateness = counted(values)
    assert lateness.maximum == max(values)
    assert lateness.quantile(q) <= max(values)
    assert lateness.quantile(1.0) == max(values)


@given(values=durations)
def test_quantiles_grow_with_the_share(values: list[int]) -> None:
    lateness = counted(values)
    quantiles = [lateness.quantile(i / 20) for i in range(21)]
    assert quantiles == sorted(quantiles)


@given(values=durations)
def test_everything_is_counted(values: list[int]) -> None:
    assert counted(values).count() == len(values)


def test_early_counts_as_on_time() -> None:
    lateness = counted([-5, -1, 0])
    assert (lateness.count(), lateness.maximum, lateness.quantile(1.0)) == (3, 0, 0)


@pytest.mark.parametrize("q", [0.0, 0.5, 1.0])
def test_nothing_counted_is_not_late(q: float) -> None:
    assert DurationHistogram().quantile(q) == 0


def test_small_durations_are_exact() -> None:
    values = list(range(64))
    lateness = counted(values)
    assert [lateness.quantile((v + 1) / 64) for v in values] == values
