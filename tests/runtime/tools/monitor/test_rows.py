"""What the screens say of a snapshot."""

from __future__ import annotations

from runtime.tools.monitor.screen import COLUMNS, LEFT, RIGHT, headline, is_number, rows
from tests.runtime.tools.monitor.samples import snapshot


def test_every_table_has_its_columns_and_a_place() -> None:
    assert {*LEFT, *RIGHT} == COLUMNS.keys()
    for name, columns in COLUMNS.items():
        found = rows(name, snapshot())
        assert found
        assert {len(row) for row in found} == {len(columns)}


def test_figures_are_rounded_and_nothing_is_said_of_what_is_not_known() -> None:
    now = snapshot()
    assert rows("nodes", now)[0] == ("drone", "running", "25.0%", "400", "1.25", "2")
    assert rows("outputs", now)[0] == (
        "drone.images", "Image", "45", "30.0", "0.02", "40.00", "41.50"
    )  # fmt: skip
    assert is_number("nodes", 2)
    assert not is_number("nodes", 1)


def test_the_headline_tells_time_pace_and_end() -> None:
    assert headline(snapshot()) == (
        "sample   1.500 of 60 s   2.00 × real time (as fast as it can)   runs"
    )
    assert headline(snapshot(clock_target_speed=0.5, clock_paused=True)).endswith(
        "(asked: 0.5)   paused"
    )
    assert headline(snapshot(clock_duration=0.0, clock_kind="real", ended="Ctrl-C")) == (
        "sample   1.500 s   2.00 × real time (real)   ends: Ctrl-C"
    )
