"""What ``--vary`` says."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import ConfigError
from runtime.tools.sweep.plan import Axis, Parameter, axis, parameter, split, value

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
plain = st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False) | texts
values = st.recursive(
    plain, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=2)
)
words = st.from_regex(r"[a-z_][a-z0-9_'\"-]{0,6}", fullmatch=True) | st.from_regex(
    r"[0-9]{1,3}(ms|s)", fullmatch=True
)
words = words.filter(lambda word: word not in {"true", "false", "inf", "nan"})


def written(value: Any) -> str:
    """Return a value as TOML writes it in one place."""
    text = tomli_w.dumps({"v": [0, value]})  # in a list of one, a table would be [[v]]
    return text.partition("0,")[2].strip().removesuffix(",\n]").strip()


@pytest.mark.slow
@given(st.lists(st.tuples(values.map(written) | words, st.sampled_from(["", " "])), min_size=1))
def test_values_are_split_at_the_commas_between_them(pieces: list[tuple[str, str]]) -> None:
    text = ",".join(space + piece + space for piece, space in pieces)
    assert split(text, "") == tuple(piece for piece, _ in pieces)


@pytest.mark.slow
@given(values)
def test_a_value_in_toml_is_read_as_such(original: Any) -> None:
    assert value(written(original)) == original


@given(words)
def test_a_bare_word_is_itself(word: str) -> None:
    assert value(word) == word


@given(st.text())
def test_no_text_gives_an_empty_value_or_another_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert all(piece == piece.strip() != "" for piece in split(text, "here"))


def test_a_path_with_values() -> None:
    result = parameter('node.key = 1, [2, "a,]"],"x,y",it\'s,80ms, {a = 1, b = 2}')
    assert result == Parameter(
        "node.key", ("1", '[2, "a,]"]', '"x,y"', "it's", "80ms", "{a = 1, b = 2}")
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("a.b", "--vary a.b: expected PATH=V1,V2,…"),
        ("=1,2", "--vary =1,2: expected PATH=V1,V2,…"),
        ("a.b=", "expected a value between commas, found none"),
        ("a.b=1,,2", "expected a value between commas, found none"),
        ("a.b=[1,2", "expected a closing ], found the end"),
        ("a.b=1,'x,y", "expected a closing ', found the end"),
        ("a.b=5,6, 5", "expected different values, found 5 a second time"),
    ],
)
def test_mistakes(change: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parameter(change)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (("5", "10.5", "-3"), Axis((5.0, 10.5, -3.0))),
        (("0ms", "80ms"), Axis((0.0, 80.0), "ms")),
        (("0", "500ms", "2s"), Axis((0.0, 0.5, 2.0), "s")),
        (("20µs", "5us"), Axis((20.0, 5.0), "µs")),
        (("yard", "hall", "sea"), Axis((0.0, 1.0, 2.0), words=True)),
        (("true", "false"), Axis((0.0, 1.0), words=True)),
        (("1", "inf"), Axis((0.0, 1.0), words=True)),
        (("[1]", "[2]"), Axis((0.0, 1.0), words=True)),
        (("80ms", "hall"), Axis((0.0, 1.0), words=True)),
    ],
)
def test_where_values_lie_on_an_axis(texts: tuple[str, ...], expected: Axis) -> None:
    result = axis(texts)
    assert result.places == pytest.approx(expected.places)
    assert (result.unit, result.words) == (expected.unit, expected.words)
