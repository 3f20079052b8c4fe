"""What ``--vary`` says: a setting and its values, and how these lie on an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec

from runtime.config.override import given
from runtime.errors import ConfigError
from runtime.units import Duration

_CLOSING = {"[": "]", "{": "}"}


class Parameter(msgspec.Struct, frozen=True):
    """A setting that a sweep varies.

    Attributes:
        path: As in ``--set``: ``camera.rate``.
        texts: Its values as they were written, each as ``--set`` takes it.
    """

    path: str
    texts: tuple[str, ...]


class Axis(msgspec.Struct, frozen=True):
    """Where a parameter's values lie in a plot.

    Attributes:
        places: One for each value, in the order of the values.
        unit: Of the places; empty if they have none.
        words: Whether the values have no place of their own, and just follow one another.
    """

    places: tuple[float, ...]
    unit: str = ""
    words: bool = False


def parameter(change: str) -> Parameter:
    """Read ``PATH=V1,V2,…``.

    Raises:
        ConfigError: It is something else, or has a value twice.
    """
    path, equals, text = change.partition("=")
    where = f"--vary {change}"
    if not equals or not path.strip():
        raise ConfigError(f"{where}: expected PATH=V1,V2,…, found no path with values")
    texts = split(text, where)
    for index, one in enumerate(texts):
        if one in texts[:index]:
            raise ConfigError(f"{where}: expected different values, found {one} a second time")
    return Parameter(path.strip(), texts)


def split(text: str, where: str) -> tuple[str, ...]:
    """Split values at the commas that stand outside brackets and quotes.

    A quote opens a text where a value begins; in the middle of a bare word it is a letter.

    Raises:
        ConfigError: A value is empty, or a bracket or quote is not closed; `where` begins the
            message.
    """
    pieces = [""]
    expected: list[str] = []  # what closes the brackets and the quote that are open
    letters = iter(text)
    for letter in letters:
        inside = expected[-1] if expected else ""
        if letter == "," and not expected:
            pieces.append("")
            continue
        pieces[-1] += letter
        if inside in {'"', "'"}:
            if letter == inside:
                expected.pop()
            elif letter == "\\" and inside == '"':
                pieces[-1] += next(letters, "")
        elif letter == inside:
            expected.pop()
        elif letter in _CLOSING:
            expected.append(_CLOSING[letter])
        elif letter in {'"', "'"} and (expected or pieces[-1].strip() == letter):
            expected.append(letter)
    if expected:
        raise ConfigError(f"{where}: expected a closing {expected[-1]}, found the end")
    found = tuple(piece.strip() for piece in pieces)
    if not all(found):
        raise ConfigError(f'{where}: expected a value between commas, found none ("" is a text)')
    return found


def value(text: str) -> Any:
    """Return what a text means: its value in TOML, or itself, as for ``--set``."""
    try:
        return given(text)
    except ValueError:  # which reading the settings refuses
        return text.strip()


def axis(texts: Sequence[str]) -> Axis:
    """Place values on an axis: numbers and durations by size, all else one after another."""
    values = [value(text) for text in texts]
    if all(type(v) in {int, float} and math.isfinite(v) for v in values):
        return Axis(tuple(float(v) for v in values))
    try:
        seconds = [Duration.parse(v) for v in values]
    except ValueError:
        return Axis(tuple(float(index) for index in range(len(values))), words=True)
    longest = max(seconds, default=0.0)
    unit, scale = ("s", 1.0) if longest >= 1 else ("ms", 1e3) if longest >= 1e-3 else ("µs", 1e6)
    return Axis(tuple(s * scale for s in seconds), unit)
