"""Text of settings.json: what it says, and where it is wrong."""

from __future__ import annotations

import json
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import ConfigError
from visnav_airsim.keys import parse

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


def test_comments_and_trailing_commas_are_accepted_and_the_first_is_named_by_line() -> None:
    text = """\ufeff{ // the drone
  "a": [1, 2,], /* two
  lines */
  "b": "no // comment, }",
  "c": NaN, "d": -Infinity,
}
"""
    table, strict, (note,) = parse(text, "settings.json")
    assert table["a"] == [1, 2]
    assert table["b"] == "no // comment, }"
    assert math.isnan(table["c"])
    assert table["d"] == -math.inf
    assert note.startswith("line 1, column 3: AirSim itself refuses that: ")
    assert json.loads(strict)["b"] == table["b"]


@pytest.mark.parametrize(
    ("text", "table", "note"),
    [
        (
            '{"a": {"b": 1, "b": 2}}',
            {"a": {"b": 2}},
            "'b' stands there more than once: the last one",
        ),
        (
            '{"a": {"b": 1, "b": 2,}}',
            {"a": {"b": 2}},
            "'b' stands there more than once: the last one",
        ),
        ('{"c": -Infinity}', {"c": -math.inf}, "-Infinity: AirSim itself refuses that"),
    ],
)
def test_what_is_odd_is_noted(text: str, table: object, note: str) -> None:
    parsed, _, notes = parse(text, "settings.json")
    assert parsed == table
    assert notes[0].startswith(note)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "settings.json: expected JSON, found: Empty strings"),
        ('{\n  "a": 1\n  "b": 2}', "expected JSON, found: <string>:3 Unexpected"),
        ("{\n /* never ends", "<string>:2 Unexpected end of input"),
        ('{"a": "\n"}', r'<string>:1 Unexpected "\n" at column 8'),
        ("[1]", "expected an object {…}, found '[1]'"),
        ('{"a": ' + "[" * 100_000, "expected objects and lists less deep in one another"),
        ('{"a": 1' + "0" * 5000 + "}", "expected JSON, found: Exceeds the limit"),
        ('{"a": "\\ud800"}', "expected Unicode, found half a surrogate pair"),
        ('{"a": ,}', "expected JSON"),
        ('{,"a": 1}', "expected JSON"),
        ('{"a": "' + '\\"' * 1000, "Unexpected end of input"),
    ],
)
def test_what_is_no_json_is_refused_with_its_place(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(expected)) as error:
        parse(text, "settings.json")
    assert "\n" not in str(error.value)


@pytest.mark.slow
@given(st.dictionaries(st.text(), VALUES, max_size=4), st.integers(0, 3))
def test_strict_json_is_read_as_it_is(table: dict[str, object], indent: int) -> None:
    text = json.dumps(table, indent=indent or None, ensure_ascii=False)
    assert parse(text, "settings.json") == (table, text, [])


@pytest.mark.slow
@given(st.dictionaries(st.text(), VALUES, max_size=4))
def test_comments_and_commas_put_into_strict_json_change_nothing(table: dict[str, object]) -> None:
    text = json.dumps(table, indent=1)
    lines = [f'{line} // ] }} , "' for line in text.splitlines()]
    decorated = re.sub(r"(\d|\"|\])( // .*\n *[\]}])", r"\1,\2", "\n".join(lines))
    assert parse(decorated, "settings.json")[0] == table


@given(st.text(alphabet='{}[]",:/*\\ \n1-NaInfity\ufeff'))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        _, strict, _ = parse(text, "settings.json")
    except ConfigError:
        return
    json.loads(strict)
