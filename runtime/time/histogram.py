"""A histogram of durations that costs one addition a sample and never grows.

Buckets are 1/32 of an octave wide, so a quantile is right to within 3 %: the scheme of
HdrHistogram (hdrhistogram.org) on integers of nanoseconds.
"""

from __future__ import annotations

_STEPS = 5  # bits of a value that are kept below its leading one


class DurationHistogram:
    """Durations in nanoseconds, counted by size."""

    __slots__ = ("_counts", "_none", "maximum")

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self._none = 0
        self.maximum = 0

    def add(self, duration: int) -> None:
        """Count one duration (ns); negative ones count as 0."""
        if duration <= 0:  # always so in lockstep
            self._none += 1
            return
        self.maximum = max(self.maximum, duration)
        shift = max(duration.bit_length() - _STEPS - 1, 0)
        bucket = (duration >> shift) + (shift << (_STEPS + 1))
        self._counts[bucket] = self._counts.get(bucket, 0) + 1

    def count(self) -> int:
        """Return how many durations were added."""
        return self._none + sum(self._counts.values())

    def quantile(self, q: float) -> int:
        """Return the duration (ns) below or at which a share `q` of them lies; 0 if none."""
        rank = q * self.count()
        seen = self._none
        if seen >= rank:
            return 0
        for bucket in sorted(self._counts, key=_upper_edge):
            seen += self._counts[bucket]
            if seen >= rank:
                return min(_upper_edge(bucket), self.maximum)
        return self.maximum


def _upper_edge(bucket: int) -> int:
    shift = bucket >> (_STEPS + 1)
    value = bucket & ((1 << (_STEPS + 1)) - 1)
    return ((value + 1) << shift) - 1
