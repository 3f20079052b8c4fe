"""Regular expressions of clients, of which none may keep the run waiting.

Python's own search goes back and tries again. What makes that long are repetitions: the time grows
with the text's length to the power of their number, and without bounds if one is in another. Each
alternative in groups may double it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable

LONGEST, MOST_REPETITIONS, MOST_CHOICES = 200, 3, 12
"""Characters, repetitions, and alternatives of an expression; each repetition counts as three."""

_PIECE = re.compile(r"\\.|\[\^?\]?(?:\\.|[^\]\\])*\]|\(\?|\)?(?:[*+?]|\{[\d,]*\})|.", re.DOTALL)


def whole_matches(expression: str, texts: Iterable[str], *, ignore_case: bool = False) -> list[str]:
    """Return the texts that an expression matches from their beginning to their end.

    Raises:
        ValueError: It is no expression; or it is longer, has more repetitions (``*``, ``+``, ``?``,
            ``{2,3}``) than are allowed, or repeats a group.
    """
    pieces = [each for each in _PIECE.findall(expression) if each[0] not in "\\["]
    repetitions = [each for each in pieces if each[-1] in "*+?}" and each not in ("(?", "}")]
    if len(expression) > LONGEST or len(repetitions) > MOST_REPETITIONS:
        raise _error(f"up to {LONGEST} characters and {MOST_REPETITIONS} repetitions", expression)
    if 3 * len(repetitions) + pieces.count("|") > MOST_CHOICES:
        raise _error("fewer alternatives", expression)
    if any(each[0] == ")" for each in repetitions):
        raise _error("no repeated group", expression)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what Python may read otherwise one day
            matches = re.compile(expression, re.IGNORECASE if ignore_case else 0).fullmatch
    except (re.error, OverflowError, RecursionError) as error:
        raise _error(f"one that can be read ({error})", expression) from None
    return [text for text in texts if matches(text)]


def _error(expected: str, found: str) -> ValueError:
    return ValueError(f"regular expression: expected {expected}, found {found!r:.80}")
