"""What a snapshot says of a run."""

from __future__ import annotations

from itertools import chain

from runtime.tools.monitor.protocol import COLUMNS, STACKS, is_number
from tests.runtime.tools.monitor.samples import snapshot


def test_every_table_has_its_columns_and_a_place() -> None:
    assert [*chain(*STACKS)] == [*COLUMNS]
    for name, columns in COLUMNS.items():
        found = snapshot().tables[name]
        assert found
        assert {len(row) for row in found} == {len(columns)}


def test_columns_are_of_words_or_numbers() -> None:
    assert is_number("nodes", 2)
    assert not is_number("nodes", 1)
    assert not is_number("links", 0)
