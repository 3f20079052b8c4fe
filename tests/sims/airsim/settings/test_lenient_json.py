"""JSON with comments and the like: what it says, and where it is wrong."""

from __future__ import annotations

import json
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import ConfigError
from sims.airsim.settings.lenient_json import DEEPEST, parse

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


def test_comments_and_trailing_commas_are_accepted_and_named_by_line() -> None:
    table, strict, warnings = parse(
        """\ufeff{ // the drone
  "a": [1, 2,], /* two
  lines */
  "b": "no // comment, }",
  "c": NaN, "d": -Infinity,
}
""",
        "settings.json",
    )
    assert table["a"] == [1, 2]
    assert table["b"] == "no // comment, }"
    assert math.isnan(table["c"])
    assert table["d"] == -math.inf
    assert warnings == [
        "a comment in line 1, 2: AirSim itself refuses that",
        "a trailing comma in line 2, 6: AirSim itself refuses that",
        "NaN in line 5: AirSim itself refuses that",
        "-Infinity in line 5: AirSim itself refuses that",
    ]
    assert json.loads(strict)["b"] == table["b"]


def test_the_last_of_equal_keys_counts() -> None:
    table, _, warnings = parse('{"a": {"b": 1, "b": 2}}', "settings.json")
    assert table == {"a": {"b": 2}}
    assert warnings == ["'b' stands there more than once: the last one counts"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "settings.json: line 1, column 1: expected JSON, found: Expecting value"),
        ('{\n  "a": 1\n  "b": 2}', "line 3, column 3: expected JSON, found: Expecting ','"),
        ("{\n /* never ends", "line 2, column"),
        ('{"a": "\n"}', "line 1, column 8: expected JSON, found: Invalid control character"),
        ("[1]", "expected an object {…}, found '[1]'"),
        ('{"a": ' + "[" * DEEPEST + "]" * DEEPEST + "}", "at most 32 deep"),
        ('{"a": ' + "[" * 100_000, "line 1: expected objects and lists at most 32 deep"),
        ('{"a": 1' + "0" * 5000 + "}", "expected numbers of a usual size"),
        ('{"a": "\\ud800"}', "expected Unicode, found half a surrogate pair"),
        ('{"a": ,}', "expected JSON"),
        ('{,"a": 1}', "expected JSON"),
        ('{"a": "' + '\\"' * 100_000, "Unterminated string"),
    ],
)
def test_what_is_no_json_is_refused_with_its_place(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(expected)):
        parse(text, "settings.json")


@given(st.dictionaries(st.text(), VALUES, max_size=4), st.integers(0, 3))
def test_strict_json_is_read_as_it_is(table: dict[str, object], indent: int) -> None:
    text = json.dumps(table, indent=indent or None, ensure_ascii=False)
    assert parse(text, "settings.json") == (table, text, [])


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
