"""The last second or so: figures over a single snapshot's interval would jump about."""

from __future__ import annotations

import collections
from collections.abc import Mapping
from typing import NamedTuple

from runtime.schedule import SECOND

KEPT = 5
"""Intervals between snapshots that figures are taken over."""


class Amount(NamedTuple):
    """What was added up of one node or output.

    Attributes:
        times: How often it was.
        total: Nanoseconds of all.
        longest: Nanoseconds of the longest.
    """

    times: int = 0
    total: int = 0
    longest: int = 0

    def plus(self, other: Amount) -> Amount:
        """Return both together."""
        return Amount(
            self.times + other.times,
            self.total + other.total,
            max(self.longest, other.longest),
        )


class Sample(NamedTuple):
    """What was known at one snapshot.

    Attributes:
        real: Seconds of `time.perf_counter`.
        run: Nanoseconds of the run's clock.
        sent: Events sent since the beginning, by output.
        nodes: What each node had of the loop since the sample before.
        outputs: What lay between stamp and delivery since then.
    """

    real: float
    run: int
    sent: Mapping[str, int]
    nodes: Mapping[str, Amount]
    outputs: Mapping[str, Amount]


class RecentSamples:
    """The last samples.

    Args:
        first: Of which but the time and what was sent by then counts.
    """

    def __init__(self, first: Sample) -> None:
        self._samples = collections.deque([first], maxlen=KEPT + 1)

    def add(self, sample: Sample) -> None:
        """Take another one."""
        self._samples.append(sample)

    @property
    def real(self) -> float:
        """Real seconds that it spans."""
        return max(self._samples[-1].real - self._samples[0].real, 1e-9)

    @property
    def run(self) -> float:
        """Seconds of the run's clock that it spans."""
        return (self._samples[-1].run - self._samples[0].run) / SECOND

    def rate(self, output: str) -> float:
        """Return how many events an output sent a second of the run's clock."""
        sent = self._samples[-1].sent.get(output, 0) - self._samples[0].sent.get(output, 0)
        return sent / self.run if self.run > 0 else 0.0

    def node(self, name: str) -> Amount:
        """Return what a node had of the loop."""
        return self._sum([sample.nodes.get(name, Amount()) for sample in self._later()])

    def output(self, name: str) -> Amount:
        """Return what lay between the stamps of an output's events and their delivery."""
        return self._sum([sample.outputs.get(name, Amount()) for sample in self._later()])

    def _later(self) -> list[Sample]:
        return list(self._samples)[1:]

    @staticmethod
    def _sum(amounts: list[Amount]) -> Amount:
        found = Amount()
        for amount in amounts:
            found = found.plus(amount)
        return found
