"""How far the monotonic clock of another machine is from ours.

Cristian's algorithm: a reply that took little time, there and back, cannot have been read off far
from the middle of it. (F. Cristian, Probabilistic clock synchronization, 1989.)
"""

from __future__ import annotations


class Offset:
    """The best of some exchanges with one process.

    Attributes:
        ns: What to add to our clock to get theirs.
        round_trip: Nanoseconds of the exchange that says so; half of it is how far off `ns` may be.
    """

    def __init__(self) -> None:
        self.ns = 0
        self.round_trip: int | None = None
        self.exchanges = 0

    def add(self, sent: int, there: int, received: int) -> None:
        """Take in an exchange: our time, theirs, and ours again."""
        self.exchanges += 1
        round_trip = received - sent
        if self.round_trip is None or round_trip < self.round_trip:
            self.round_trip = round_trip
            self.ns = there - (sent + received) // 2
