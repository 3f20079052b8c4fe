"""What a snapshot says of a run."""

from __future__ import annotations

from runtime.tools.monitor.protocol import COLUMNS, LEFT, RIGHT, is_number
from tests.runtime.tools.monitor.samples import snapshot


def test_every_table_has_its_columns_and_a_place() -> None:
    assert {*LEFT, *RIGHT} == COLUMNS.keys()
    for name, columns in COLUMNS.items():
        found = snapshot().tables[name]
        assert found
        assert {len(row) for row in found} == {len(columns)}


def test_columns_are_of_words_or_numbers() -> None:
    assert is_number("nodes", 2)
    assert not is_number("nodes", 1)
    assert not is_number("links", 0)


def test_the_headline_tells_time_pace_and_end() -> None:
    assert snapshot().headline == (
        "sample   1.500 of 60 s   2.00 × real time (as fast as it can)   runs"
    )
    assert snapshot(clock_target_speed=0.5, clock_paused=True).headline.endswith(
        "(asked: 0.5)   paused"
    )
    assert snapshot(clock_duration=0.0, clock_kind="real", ended="Ctrl-C").headline == (
        "sample   1.500 s   2.00 × real time (real)   ends: Ctrl-C"
    )
