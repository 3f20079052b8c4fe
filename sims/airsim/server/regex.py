"""Regular expressions of clients, matched in bounded time.

Python's own search goes back and tries again, for hours with some expressions; here all ways are
followed at once, as by K. Thompson, "Regular expression search algorithm", 1968.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from typing import NamedTuple

LONGEST, MOST_STATES = 120, 1000
"""Characters of an expression, and states of what is made of it."""

_PIECE = re.compile(
    r"\\.|\[\^?\]?(?:\\.|[^\]\\])*\]|\{\d{1,4}(?:,\d{0,4})?\}\??|[*+?]\??|\(\?:|.", re.DOTALL
)


class _State(NamedTuple):
    """One state: what the next character must match, `None` for no character, and what follows."""

    test: re.Pattern[str] | None
    after: list[int]


def whole_matches(expression: str, texts: Iterable[str], *, ignore_case: bool = False) -> list[str]:
    """Return the texts that an expression matches from their beginning to their end.

    It may have characters and their classes, groups, alternatives and repetitions; no references
    to groups, and no looking ahead or behind.

    Raises:
        ValueError: It is no such expression, or too long.
    """
    if len(expression) > LONGEST:
        raise ValueError(
            f"expected a regular expression of up to {LONGEST} characters, found {len(expression)}"
        )
    states = _Parser(expression, re.IGNORECASE if ignore_case else re.NOFLAG).states
    known: dict[tuple[frozenset[int], str], frozenset[int]] = {}
    first, end = _reached(states, {0}), len(states) - 1
    found = []
    for text in texts:
        now = first
        for character in text:
            key = now, character
            if key not in known:
                known[key] = _reached(
                    states,
                    {
                        state
                        for each in now
                        if (test := states[each].test) is not None and test.fullmatch(character)
                        for state in states[each].after
                    },
                )
            now = known[key]
        if end in now:
            found.append(text)
    return found


def _reached(states: list[_State], begin: set[int]) -> frozenset[int]:
    """Return the states in which one may be without a further character."""
    found, to_do = set(begin), list(begin)
    while to_do:
        state = states[to_do.pop()]
        new = set(state.after) - found if state.test is None else set[int]()
        found |= new
        to_do += new
    return frozenset(found)


class _Parser:
    """Makes states of an expression: the first is 0, the last the one after a whole match."""

    def __init__(self, expression: str, flags: re.RegexFlag) -> None:
        self._flags = flags
        self._expression = expression
        pieces = _PIECE.findall(expression)
        self._pieces = pieces[pieces[:1] == ["^"] : len(pieces) - (pieces[-1:] == ["$"])]
        self._at = 0
        self.states: list[_State] = [_State(None, [])]
        last = self._alternatives(0)
        if self._at < len(self._pieces):
            raise self._error("an opening bracket before each closing one")
        self.states[last].after.append(self._add())

    def _alternatives(self, begin: int) -> int:
        ends = [self._sequence(begin)]
        while self._next() == "|":
            self._at += 1
            ends.append(self._sequence(begin))
        end = self._add()
        for each in ends:
            self.states[each].after.append(end)
        return end

    def _sequence(self, begin: int) -> int:
        while self._next() not in ("", "|", ")"):
            begin = self._repeated(begin)
        return begin

    def _repeated(self, begin: int) -> int:
        """Parse one item and its repetition; an item is parsed again for each of its copies."""
        start = self._at
        entry = self._follow(begin)
        end = self._item(entry)
        piece = self._next()
        if not piece or piece[0] not in "*+?{" or piece == "{":
            return end
        after = self._at + 1
        low, high = _bounds(piece)
        if high is not None and high < low:
            raise self._error("rising numbers in {}")
        ends = [] if low else [entry]
        for number in range(2, max(low, high or 1) + 1):
            if number > low:
                ends.append(end)
            entry = self._follow(end)
            self._at = start
            end = self._item(entry)
        if high is None:
            self.states[end].after.append(entry)
        self._at = after
        final = self._add()
        for each in [*ends, end] if high != 0 else [begin]:
            self.states[each].after.append(final)
        return final

    def _item(self, begin: int) -> int:
        piece = self._next()
        self._at += 1
        if piece in ("(", "(?:"):
            end = self._alternatives(begin)
            if self._next() != ")":
                raise self._error("a closing bracket")
            self._at += 1
            return end
        if piece[0] in "*+?^$" or piece == "\\" or re.fullmatch(r"\\[0-9AbBZzkpP]", piece):
            raise self._error(f"something else than {piece}")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of what Python may read otherwise one day
                test = re.compile(re.escape(piece) if piece in "{}]" else piece, self._flags)
        except re.error as error:
            raise self._error(f"no {error}") from None
        self.states.append(_State(test, []))
        self.states[begin].after.append(len(self.states) - 1)
        self.states[-1].after.append(self._add())
        return len(self.states) - 1

    def _follow(self, begin: int) -> int:
        new = self._add()
        self.states[begin].after.append(new)
        return new

    def _add(self) -> int:
        if len(self.states) >= MOST_STATES:
            raise self._error("fewer repetitions")
        self.states.append(_State(None, []))
        return len(self.states) - 1

    def _next(self) -> str:
        return self._pieces[self._at] if self._at < len(self._pieces) else ""

    def _error(self, expected: str) -> ValueError:
        return ValueError(f"regular expression: expected {expected}, found {self._expression!r}")


def _bounds(piece: str) -> tuple[int, int | None]:
    """Return how often an item may be there; `None` is for ever."""
    if piece[0] != "{":
        return {"*": (0, None), "+": (1, None), "?": (0, 1)}[piece[0]]
    low, comma, high = piece.rstrip("?")[1:-1].partition(",")
    if not comma:
        return int(low), int(low)
    return int(low), int(high) if high else None
