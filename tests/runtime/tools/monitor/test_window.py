"""Figures over the last second or so."""

from __future__ import annotations

import pytest

from runtime.tools.monitor.window import KEPT, Amount, Sample, Window

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
    window = Window(sample(0))
    for n in range(1, 11):
        window.add(sample(n))
    assert KEPT == 5
    assert window.real == pytest.approx(1.0)
    assert window.run == 2.0
    assert window.rate("a.out") == (100 - 25) / 2
    assert window.node("a") == Amount(5, 10 * (6 + 7 + 8 + 9 + 10), 100)
    assert window.output("a.out") == Amount(10, 40, 10)


def test_there_is_nothing_before_the_second_sample_and_of_strangers() -> None:
    window = Window(sample(3))
    assert (window.run, window.rate("a.out"), window.node("a")) == (0.0, 0.0, Amount())
    window.add(sample(4))
    assert (window.node("b"), window.rate("b.out")) == (Amount(), 0.0)
