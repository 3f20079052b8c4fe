"""How late a 400 Hz tick comes while a multirotor hovers: what several benchmarks measure."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from events import Takeoff
from runtime import Node, NodeConfig, Output, Tick, every

C = TypeVar("C", bound=NodeConfig)


class LateRow(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the rows.

    Attributes:
        ticks: How many ticks were measured.
        late_p50_us: Median lateness of the 400 Hz tick, microseconds.
        late_p99_us: Its 99th percentile; of several runs, the median of theirs.
        late_max_us: Its maximum.
        ratio_p99: Of the 99th percentile, to that of the row or of the runs that it is held
            against.
    """

    ticks: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    ratio_p99: float = 1.0


class Beat(NamedTuple):
    """A tick: its stamp, when it came (monotonic clock, ns), how late (ns), and how many missed."""

    stamp: int
    at: int
    late: int
    missed: int


EDGE_NS = 30_000_000
"""At either end of a window, ticks are left out for so long: what was sent may be under way."""

BEATS: list[Beat] = []
"""The ticks of the probe of this process; whoever measures clears it."""


class TakeoffNode(Node[C]):
    """Base of the nodes that measure a flying vehicle: sends it up when the run begins."""

    commands = Output(Takeoff)

    async def run(self) -> None:
        """Take off."""
        self.commands.send(Takeoff(stamp=self.clock.now(), source=self.name))


class Probe(TakeoffNode[NodeConfig]):
    """Measures how late a 400 Hz tick comes, and sends the vehicle up."""

    @every(hz=400)
    def tick(self, tick: Tick) -> None:
        """Note how late it is."""
        BEATS.append(Beat(tick.stamp, time.monotonic_ns(), tick.late, tick.missed))


PROBE: dict[str, Any] = {"name": "probe", "type": f"{__name__}:Probe"}


def figures(runs: Sequence[Any]) -> dict[str, Any]:
    """Return the fields of a row; each run is a list of lateness, nanoseconds."""
    late = np.concatenate(runs) / 1e3
    return {
        "ticks": len(late),
        "late_p50_us": float(np.median(late)),
        "late_p99_us": float(np.median([np.percentile(run, 99) for run in runs])) / 1e3,
        "late_max_us": float(late.max()),
    }


def lateness(begin: int, end: int) -> npt.NDArray[np.float64]:
    """Return how late the ticks of a window of time (monotonic clock, ns) were, nanoseconds."""
    inside = (beat.late for beat in BEATS if begin + EDGE_NS < beat.at < end - EDGE_NS)
    return np.array([*inside], np.float64)
