"""Ticks and other entries due at integer nanoseconds of the run's clock, and how late they were.

Both clocks keep one `Schedule`; they differ in how they get from one due time to the next. Entries
due at the same time run in the order in which they were added, which for ticks is the order of the
nodes in the file. A `Histogram` of lateness costs one addition a sample and never grows.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from fractions import Fraction
from typing import Any, Protocol

import msgspec

_STEPS = 5  # bits of a value that are kept below its leading one


class DurationHistogram:
    """Durations in nanoseconds, counted by size."""

    __slots__ = ("_counts", "_none", "maximum")

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self._none = 0
        self.maximum = 0

    def add(self, duration: int) -> None:
        """Count a duration (ns); negative values count as 0."""
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
        """Return the duration (ns) not exceeded by a share `q` of all; 0 if none."""
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


SECOND = 1_000_000_000


class Tick(msgspec.Struct, frozen=True, gc=False):
    """A call of an `@every` method.

    Attributes:
        stamp: Nanoseconds at which it was due. After missed ticks, the last of them.
        index: Periods since the first tick.
        late: Nanoseconds from the first due time not yet served to this call.
        missed: Ticks skipped because the last call or something else took too long.
    """

    stamp: int
    index: int
    late: int
    missed: int


class Entry(Protocol):
    """Something in the schedule."""

    def fire(self, due: int, now: int) -> int | None:
        """Run, and return when to run again, or `None`."""


class Schedule:
    """A queue of due times."""

    def __init__(self) -> None:
        self.heap: list[tuple[int, int, Entry]] = []
        self.order = 0  # number of the next entry added; the lowest comes first among equal times
        self.on_sooner: Callable[[int], None] = _ignore
        """Called when an entry is added with a due time (ns) before all others."""

    def add(self, due: int, entry: Entry) -> None:
        """Run `entry` at `due`, after entries added earlier for the same time."""
        order = self.order
        self.order = order + 1
        self._push((due, order, entry))

    def next_due(self) -> int | None:
        """Return the earliest due time, or `None` if nothing is due ever."""
        return self.heap[0][0] if self.heap else None

    def run_first(self, now: int) -> None:
        """Run the entry due first; when repeated, its place among equal times stays."""
        heap = self.heap
        item = due, order, entry = heap[0]
        again = None
        try:
            again = entry.fire(due, now)
        finally:
            if heap[0] is not item:  # it added something for an earlier time
                heap.remove(item)
                heapq.heapify(heap)
                heapq.heappush(heap, item := (-1, order, entry))
            if again is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (again, order, entry))

    def run_due(self, now: Callable[[], int]) -> None:
        """Run all entries due by now, in order; those due meanwhile are left for later."""
        limit = now()
        while self.heap and self.heap[0][0] <= limit:
            self.run_first(now())

    def _push(self, item: tuple[int, int, Entry]) -> None:
        heapq.heappush(self.heap, item)
        if self.heap[0] is item:
            self.on_sooner(item[0])


class Once:
    """Calls a function once, unless cancelled before."""

    __slots__ = ("call",)

    def __init__(self, call: Callable[[], Any]) -> None:
        self.call: Callable[[], Any] | None = call

    def fire(self, due: int, now: int) -> None:  # noqa: ARG002
        """Call the function, unless cancelled."""
        if self.call is not None:
            self.call()

    def cancel(self) -> None:
        """Do nothing when the time comes."""
        self.call = None


class Ticker:
    """Calls a function at a steady rate.

    Args:
        name: ``node.method``, for statistics.
        hz: Rate; due times are exact multiples of its period, rounded down to nanoseconds.
        fault: Called with what `call` raises.
        before: The ticker that this one replaces, whose statistics it carries on.
    """

    __slots__ = (
        "_call", "_fault", "_function", "_hz", "_index", "_period", "_start", "calls", "late",
        "missed", "name", "stopped",
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        hz: float,
        call: Callable[[Tick], Any],
        fault: Callable[[BaseException], None],
        before: Ticker | None = None,
    ) -> None:
        self.name = name
        self.calls: int = before.calls if before else 0
        self.missed: int = before.missed if before else 0
        self.late: DurationHistogram = before.late if before else DurationHistogram()
        self.stopped = False
        self._hz = Fraction(hz).limit_denominator(1_000_000) or Fraction(hz)
        self._period = SECOND * self._hz.denominator  # times the numerator: an integer
        self._function = self._call = call
        self._fault = fault
        self._start = 0
        self._index = 0

    def wrap_call(self, wrap: Callable[[Callable[[Tick], Any]], Callable[[Tick], Any]]) -> None:
        """Call the function wrapped by `wrap` from now on, without any earlier wrapper."""
        self._call = wrap(self._function)

    def begin(self, start: int) -> None:
        """Have the first tick at `start` (ns)."""
        self._start = start
        self._index = 0

    @property
    def hz(self) -> float:
        """Ticks per second."""
        return float(self._hz)

    @property
    def due(self) -> int:
        """When the next tick is due (ns)."""
        return self._start + self._index * self._period // self._hz.numerator

    def fire(self, due: int, now: int) -> int | None:
        """Call the function, and return its next due time (ns); `None` if stopped."""
        if self.stopped:
            return None
        late = now - due
        missed = 0
        if late > 0:
            last = (now - self._start) * self._hz.numerator // self._period
            missed = max(last - self._index, 0)
            if missed:
                self._index += missed
                self.missed += missed
        tick = Tick(self.due if missed else due, self._index, late, missed)
        self._index += 1
        self.calls += 1
        self.late.add(late)
        try:
            self._call(tick)
        except BaseException as error:  # even that must not take the other ticks with it
            self._fault(error)
        return self.due


def _ignore(_: int) -> None:
    pass
