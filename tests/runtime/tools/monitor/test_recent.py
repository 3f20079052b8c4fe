"""Figures over the last second or so."""

from __future__ import annotations

import pytest

from runtime.tools.monitor.snapshot import KEPT, Amount, RecentSamples, Sample

SECOND = 1_000_000_000


def sample(n: int) -> Sample:
    """Return what is known at the n-th fifth of a second: time goes twice as fast as real time."""
    return Sample(
        n / 5,
        n * SECOND * 2 // 5,
        {"a.out": n * n},
        {"a": Amount(1, 10 * n, 10 * n)},
        {"a.out": Amount(2, n, n)},
    )


def test_it_spans_the_last_samples_and_adds_up_what_lies_between() -> None:
    recent = RecentSamples(sample(0))
    for n in range(1, 11):
        recent.add(sample(n))
    assert KEPT == 5
    assert recent.real == pytest.approx(1.0)
    assert recent.run == 2.0
    assert recent.rate("a.out") == (100 - 25) / 2
    assert recent.node("a") == Amount(5, 10 * (6 + 7 + 8 + 9 + 10), 100)
    assert recent.output("a.out") == Amount(10, 40, 10)


def test_there_is_nothing_before_the_second_sample_and_of_strangers() -> None:
    recent = RecentSamples(sample(3))
    assert (recent.run, recent.rate("a.out"), recent.node("a")) == (0.0, 0.0, Amount())
    recent.add(sample(4))
    assert (recent.node("b"), recent.rate("b.out")) == (Amount(), 0.0)
