"""Schedules that change while they run: entries added, cancelled, failing, or always late."""

from __future__ import annotations

import pytest

from runtime.time.clock import Once, Schedule, Tick, Ticker


def run_until(schedule: Schedule, end: int) -> None:
    while (due := schedule.next_due()) is not None and due <= end:
        schedule.run_first(due)


@pytest.mark.parametrize("due", [3, 5, 7])
def test_an_entry_added_by_a_running_one_runs_when_due(due: int) -> None:
    """Also one for a time that has passed already, and one for this very time."""
    log: list[str] = []
    schedule = Schedule()

    def add() -> None:
        schedule.add(due, Once(lambda: log.append("added")))

    schedule.add(5, Once(add))
    schedule.add(6, Once(lambda: log.append("six")))
    run_until(schedule, 10)
    assert log == (["added", "six"] if due < 6 else ["six", "added"])


@pytest.mark.parametrize("due", [0, 100_000_000, 250_000_000])
def test_a_ticker_that_adds_entries_goes_on_itself(due: int) -> None:
    log: list[str] = []
    schedule = Schedule()

    def tick(at: Tick) -> None:
        log.append(f"tick {at.index}")
        if at.index == 1:
            schedule.add(due, Once(lambda: log.append("added")))

    schedule.add(0, Ticker("n.tick", 10, tick, lambda _: None))
    run_until(schedule, 300_000_000)
    place = 2 if due <= 100_000_000 else 3
    expected = [f"tick {i}" for i in range(4)]
    expected.insert(place, "added")
    assert log == expected


def test_a_cancelled_entry_does_nothing() -> None:
    log: list[int] = []
    schedule = Schedule()
    once = Once(lambda: log.append(1))
    schedule.add(5, once)
    once.cancel()
    run_until(schedule, 5)
    assert log == []


def test_an_entry_that_raises_is_not_run_again() -> None:
    schedule = Schedule()

    def fail() -> None:
        raise ValueError("once")

    schedule.add(5, Once(fail))
    with pytest.raises(ValueError, match="once"):
        schedule.run_first(5)
    assert schedule.next_due() is None


def test_something_sooner_is_made_known() -> None:
    made_known: list[int] = []
    schedule = Schedule()
    schedule.on_sooner = made_known.append
    for due in (5, 7, 3):
        schedule.add(due, Once(lambda: None))
    assert made_known == [5, 3]


def test_run_due_leaves_what_falls_due_meanwhile_for_later() -> None:
    """A ticker slower than its own period must not keep the loop to itself."""
    now = 0
    schedule = Schedule()
    ticks: list[Tick] = []

    def take_two_periods_and_a_half(tick: Tick) -> None:
        nonlocal now
        ticks.append(tick)
        now += 250_000_000
        assert len(ticks) < 10, "run_due never ends"

    schedule.add(
        0, Ticker("n.tick", 10, take_two_periods_and_a_half, lambda e: pytest.fail(str(e)))
    )
    schedule.run_due(lambda: now)
    assert len(ticks) == 1
    schedule.run_due(lambda: now)
    assert ticks[1] == Tick(stamp=200_000_000, index=2, late=150_000_000, missed=1)


def test_run_due_measures_lateness_anew_for_each_entry() -> None:
    now = 0
    lates: list[int] = []

    def slow(_: Tick) -> None:
        nonlocal now
        now += 40

    def note(tick: Tick) -> None:
        lates.append(tick.late)

    schedule = Schedule()
    for call in (slow, note):
        schedule.add(0, Ticker("n.tick", 10, call, lambda _: None))
    schedule.run_due(lambda: now)
    assert lates == [40]
