"""Durations as they stand in a file."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime import Duration
from runtime.units import LONGEST_BARE, ROUNDING, Latency, plain, significant

FACTORS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}


@given(
    number=st.floats(0, 1e5).map(repr) | st.integers(0, 10**5).map(str),
    unit=st.sampled_from(list(FACTORS)),
    space=st.sampled_from(["", " ", "  "]),
    change=st.sampled_from([str.lower, str.upper, str.title]),
)
def test_a_number_with_a_unit_is_so_many_seconds(
    number: str, unit: str, space: str, change: type[str]
) -> None:
    parsed = Duration.parse(f"{space}{number}{space}{change(unit)}{space}")
    assert parsed == pytest.approx(float(number) * FACTORS[unit])


@given(st.floats(0, 1e9) | st.integers(0, 10**9))
def test_a_bare_number_is_seconds(number: float) -> None:
    parsed = Duration.parse(number)
    assert parsed == number
    assert isinstance(parsed, Duration)


@pytest.mark.parametrize(
    "text", ["80\N{MICRO SIGN}s", "80\N{GREEK SMALL LETTER MU}s", "80us", "80 US"]
)
def test_both_letters_mu_are_micro(text: str) -> None:
    assert Duration.parse(text) == pytest.approx(80e-6)


@given(st.floats(0, 1e9))
def test_what_was_parsed_parses_again(number: float) -> None:
    assert Duration.parse(f"{Duration.parse(number)!r}s") == number


@pytest.mark.parametrize(
    "value",
    [
        True,
        None,
        [],
        float("nan"),
        float("inf"),
        10**400,
        "",
        "5",
        "s",
        "5s 5s",
        "1e400s",
        "5 m s",
        "nan s",
    ],
)
def test_anything_else_is_refused_with_examples(value: object) -> None:
    with pytest.raises(ValueError, match=r'expected a duration such as 0\.5, "80ms" or "2min"'):
        Duration.parse(value)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (-1, "that is not negative"),
        ("-3s", "that is not negative"),
        ("5 parsecs", 'found "5 parsecs", of no known unit; expected a duration in ns, us'),
        ("40 msec", r'of no known unit \(did you mean "40ms"\?\)'),
        ("2 Minutes", r'did you mean "2min"\?'),
        ("-1 m", r'did you mean "-1min"\?'),
    ],
)
def test_what_is_wrong_with_a_duration_is_said(value: object, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        Duration.parse(value)


@given(st.text())
def test_no_text_raises_anything_else(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert Duration.parse(text) >= 0.0


@given(st.floats(0, 1e6) | st.integers(0, 10**6))
def test_a_latency_is_a_number_up_to_a_second_and_has_a_unit_above(number: float) -> None:
    if number <= LONGEST_BARE:
        assert Latency.parse(number) == number
    else:
        with pytest.raises(ValueError, match=r'did you mean ".*ms"\? or ".*s"'):
            Latency.parse(number)
    assert Latency.parse(f"{float(number)!r}s") == number


@given(st.floats(0, 1e9))
def test_a_latency_that_is_written_is_read_as_it_was(seconds: float) -> None:
    assert Latency.parse(plain(Latency(seconds))) == seconds
    assert Duration.parse(plain(Duration(seconds))) == seconds


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (180.0, 2, "180"), (183.2, 2, "180"), (12345678.0, 4, "12350000"), (0.05, 4, "0.05"),
        (0.00012345, 3, "0.000123"), (1.11e-14, 4, "0"), (-1e-9, 4, "0"), (99.996, 4, "100"),
        (0.0, 2, "0"), (-2.5, 4, "-2.5"), (float("inf"), 2, "inf"), (float("nan"), 2, "nan"),
    ],
)  # fmt: skip
def test_a_figure_has_digits_and_no_exponent(value: float, digits: int, text: str) -> None:
    assert significant(value, digits) == text


@given(st.floats(ROUNDING, 1e9), st.integers(1, 9))
def test_a_figure_is_as_near_as_its_digits(value: float, digits: int) -> None:
    text = significant(value, digits)
    assert "e" not in text
    assert float(text) == float(f"{value:.{digits}g}")
