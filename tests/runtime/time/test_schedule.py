"""Due times: exact, in order, and what becomes of ticks that were missed."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.time.clock import SECOND, Once, Schedule, Tick, Ticker

MS = 1_000_000


def a_ticker(hz: float, call: Callable[[Tick], Any] = lambda _: None) -> Ticker:
    def fault(error: BaseException) -> None:
        raise error

    return Ticker("n.tick", hz, call, fault)


def run_until(schedule: Schedule, end: int) -> None:
    """Run what is due up to `end`, each at its due time."""
    while (due := schedule.next_due()) is not None and due <= end:
        schedule.run_first(due)


@pytest.mark.slow
@given(
    rate=st.sampled_from([Fraction(30), Fraction(400), Fraction(7), Fraction(30000, 1001)])
    | st.fractions(Fraction(1, 100), 100_000, max_denominator=1000),
    index=st.integers(0, 10_000_000),
    start=st.integers(0, 10**15),
)
def test_a_tick_is_due_at_the_exact_multiple_of_its_period_however_late(
    rate: Fraction, index: int, start: int
) -> None:
    ticker = a_ticker(float(rate))
    ticker.begin(start)
    ticker._index = index
    assert ticker.due == start + (index * SECOND / rate).__floor__()


def test_thirty_hertz_do_not_drift() -> None:
    stamps: list[int] = []
    schedule, ticker = Schedule(), a_ticker(30, lambda tick: stamps.append(tick.stamp))
    ticker.begin(5)
    schedule.add(ticker.due, ticker)
    run_until(schedule, 5 + 100 * SECOND)
    assert stamps == [5 + i * SECOND // 30 for i in range(3001)]


def test_a_very_slow_rate_has_a_due_time_too() -> None:
    ticker = a_ticker(1e-8)
    ticker._index = 1
    assert ticker.due == pytest.approx(1e17)


def test_what_is_due_at_one_time_runs_in_the_order_in_which_it_was_added() -> None:
    log: list[str] = []
    schedule = Schedule()
    schedule.add(10, Once(lambda: log.append("b")))
    schedule.add(5, Once(lambda: log.append("a")))
    schedule.add(10, Once(lambda: log.append("c")))
    run_until(schedule, 10)
    assert log == ["a", "b", "c"]


def test_tickers_keep_their_order_among_equals_for_ever() -> None:
    log: list[str] = []
    schedule = Schedule()
    for name, hz in (("fast", 20), ("slow", 10), ("also", 20)):
        schedule.add(0, a_ticker(hz, lambda _, name=name: log.append(name)))  # type: ignore[misc]
    run_until(schedule, 150 * MS)
    assert log == [*("fast", "slow", "also"), *("fast", "also")] * 2


def test_missed_ticks_are_counted_and_the_last_of_them_is_served() -> None:
    ticks: list[Tick] = []
    ticker = a_ticker(100, ticks.append)
    again = ticker.fire(0, 35 * MS)
    assert ticks == [Tick(stamp=30 * MS, index=3, late=35 * MS, missed=3)]
    assert (again, ticker.missed, ticker.calls) == (40 * MS, 3, 1)


def test_a_tick_that_is_late_by_less_than_a_period_misses_none() -> None:
    ticks: list[Tick] = []
    ticker = a_ticker(100, ticks.append)
    assert ticker.fire(0, 9 * MS) == 10 * MS
    assert ticks == [Tick(stamp=0, index=0, late=9 * MS, missed=0)]


@given(hz=st.sampled_from([30, 60, 400, 29.97]), waits=st.lists(st.integers(0, 10**9)))
def test_every_period_is_served_or_missed(hz: float, waits: list[int]) -> None:
    ticks: list[Tick] = []
    ticker, now = a_ticker(hz, ticks.append), 0
    for wait in waits:
        due = ticker.due
        now = max(now, due) + wait
        ticker.fire(due, now)
    assert ticker.missed + ticker.calls == (ticks[-1].index + 1 if ticks else 0)
    assert all(tick.stamp <= now for tick in ticks)
    assert [tick.stamp for tick in ticks] == sorted({tick.stamp for tick in ticks})


def test_a_stopped_ticker_is_not_called_and_not_due_again() -> None:
    log: list[Tick] = []
    schedule, ticker = Schedule(), a_ticker(10, log.append)
    schedule.add(0, ticker)
    run_until(schedule, 0)
    ticker.stopped = True
    run_until(schedule, SECOND)
    assert (len(log), schedule.next_due()) == (1, None)


def test_an_error_goes_to_the_fault_and_the_ticker_goes_on() -> None:
    faults: list[str] = []

    def fail(tick: Tick) -> None:
        raise ValueError(str(tick.index))

    ticker = Ticker("n.tick", 10, fail, lambda error: faults.append(str(error)))
    schedule = Schedule()
    schedule.add(0, ticker)
    run_until(schedule, 200 * MS)
    assert faults == ["0", "1", "2"]


def test_a_ticker_that_replaces_another_carries_its_statistics_on() -> None:
    before = a_ticker(100)
    before.fire(0, 35 * MS)
    after = Ticker("n.tick", 100, lambda _: None, lambda _: None, before)
    after.fire(0, 0)
    assert (after.calls, after.missed, after.late.count()) == (2, 3, 2)
