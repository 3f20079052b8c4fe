"""How far the clocks of another process are from ours.

Cristian's algorithm: a reply that took little time, there and back, cannot have been read off far
from the middle of it. (F. Cristian, Probabilistic clock synchronization, 1989.)
"""

from __future__ import annotations

import collections
from typing import NamedTuple

KEPT = 20
"""Exchanges that are remembered."""


class Exchange(NamedTuple):
    """The result of one question and its answer, in nanoseconds.

    Attributes:
        round_trip: What they took; half of it is how far off the others may be.
        offset: What to add to our monotonic clock to get theirs.
        late: How much less than theirs our clock of the run shows.
    """

    round_trip: int
    offset: int
    late: int


class Exchanges:
    """The latest exchanges with one process; the quickest of them counts.

    Attributes:
        count: How many there were in all.
    """

    def __init__(self) -> None:
        self.count = 0
        self._latest: collections.deque[Exchange] = collections.deque(maxlen=KEPT)

    def add(self, exchange: Exchange) -> None:
        """Take one in; in any thread."""
        self._latest.append(exchange)
        self.count += 1

    def best(self, latest: int = KEPT) -> Exchange | None:
        """Return the quickest of the latest exchanges, if there were any."""
        return min(list(self._latest)[-latest:], default=None)
