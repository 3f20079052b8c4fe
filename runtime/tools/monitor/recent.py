"""Figures of the last second or so, which are steadier than those of one interval."""

from __future__ import annotations

import collections
from collections.abc import Mapping
from typing import NamedTuple

from runtime.schedule import SECOND

KEPT = 5
"""How many intervals between snapshots figures cover."""


class Amount(NamedTuple):
    """Durations of one node or output, added up.

    Attributes:
        times: How many they are.
        total: Their sum, nanoseconds.
        longest: The longest, nanoseconds.
    """

    times: int = 0
    total: int = 0
    longest: int = 0

    def plus(self, other: Amount) -> Amount:
        """Return both, added up."""
        return Amount(
            self.times + other.times,
            self.total + other.total,
            max(self.longest, other.longest),
        )


class Sample(NamedTuple):
    """Counters at one snapshot.

    Attributes:
        real: Seconds of `time.perf_counter`.
        run: Nanoseconds of the run's clock.
        sent: Events sent since the run began, by output.
        nodes: Time that each node took of the loop since the sample before.
        outputs: Times from stamp to delivery since then.
    """

    real: float
    run: int
    sent: Mapping[str, int]
    nodes: Mapping[str, Amount]
    outputs: Mapping[str, Amount]


class RecentSamples:
    """The last samples.

    Args:
        first: Only its times and its count of sent events are used.
    """

    def __init__(self, first: Sample) -> None:
        self._samples = collections.deque([first], maxlen=KEPT + 1)

    def add(self, sample: Sample) -> None:
        """Add a sample and forget the oldest."""
        self._samples.append(sample)

    @property
    def real(self) -> float:
        """Real seconds that the samples span."""
        return max(self._samples[-1].real - self._samples[0].real, 1e-9)

    @property
    def run(self) -> float:
        """Seconds of the run's clock that the samples span."""
        return (self._samples[-1].run - self._samples[0].run) / SECOND

    def rate(self, output: str) -> float:
        """Return how many events an output sent per second of the run's clock."""
        sent = self._samples[-1].sent.get(output, 0) - self._samples[0].sent.get(output, 0)
        return sent / self.run if self.run > 0 else 0.0

    def node(self, name: str) -> Amount:
        """Return how much of the loop's time a node took."""
        return self._sum([sample.nodes.get(name, Amount()) for sample in self._later()])

    def output(self, name: str) -> Amount:
        """Return the times from the stamps of an output's events to their delivery."""
        return self._sum([sample.outputs.get(name, Amount()) for sample in self._later()])

    def _later(self) -> list[Sample]:
        return list(self._samples)[1:]

    @staticmethod
    def _sum(amounts: list[Amount]) -> Amount:
        found = Amount()
        for amount in amounts:
            found = found.plus(amount)
        return found
