"""What a snapshot says of a run."""

from __future__ import annotations

from itertools import chain

from runtime.tools.monitor.protocol import COLUMNS, STACKS, formatted
from tests.runtime.tools.monitor.samples import snapshot


def test_every_table_has_its_columns_and_a_place() -> None:
    assert [*chain(*STACKS)] == [*COLUMNS]
    for name, columns in COLUMNS.items():
        rows = snapshot().tables[name]
        assert rows
        assert {len(row) for row in rows} == {len(columns)}


def test_columns_are_of_words_or_numbers() -> None:
    assert COLUMNS["nodes"]["loop"]
    assert not COLUMNS["nodes"]["condition"]
    assert not COLUMNS["links"]["link"]
    assert formatted("links", [("pilot.fly", 3, None)]) == [("pilot.fly", "3", "")]
