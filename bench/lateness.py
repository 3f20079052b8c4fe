"""Lateness of a 400 Hz tick while a multirotor hovers, for several benchmarks.

Here: the cost of a recorder to such a controller, with a 512×512 RGB-D camera at 30 Hz, on the real
clock. Runs with a recorder and without take turns, and the ratio is the median of the pairs'.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from bench.system import in_turns
from events import Takeoff
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.config.reading import parse
from runtime.run.execute import execute

C = TypeVar("C", bound=NodeConfig)


class LateRow(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the rows.

    Attributes:
        late_p50_us: Median lateness of the 400 Hz tick, microseconds.
        late_p99_us: Its 99th percentile; of several runs, the median of theirs.
        ratio_p99: Of the 99th percentile, to that of the row or of the runs that it is held
            against.
    """

    ticks: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    ratio_p99: float = 1.0


class Beat(NamedTuple):
    """Tick: stamp, arrival (monotonic clock, ns), lateness (ns), count of missed ticks."""

    stamp: int
    at: int
    late: int
    missed: int


EDGE_NS = 30_000_000
"""Margin at both ends of a window whose ticks are left out, ns: messages may be late."""

BEATS: list[Beat] = []  # ticks of this process's probe; the measuring code clears the list


class TakeoffNode(Node[C]):
    """Base of the nodes to measure a flying vehicle: commands take-off at the start."""

    commands = Output(Takeoff)

    async def run(self) -> None:
        """Take off."""
        self.commands.send(Takeoff(stamp=self.clock.now(), source=self.name))


class Probe(TakeoffNode[NodeConfig]):
    """Measures how late a 400 Hz tick comes, and sends the vehicle up."""

    @every(hz=400)
    def tick(self, tick: Tick) -> None:
        """Record the tick's lateness."""
        BEATS.append(Beat(tick.stamp, time.monotonic_ns(), tick.late, tick.missed))


PROBE: dict[str, Any] = {"name": "probe", "type": f"{__name__}:Probe"}


def hover(benchmark: str, seconds: float, *nodes: dict[str, Any]) -> None:
    """Run a hovering multirotor on the real clock, with the probe and further nodes."""
    BEATS.clear()
    run = {"clock": "real", "duration": seconds, "log": "error"}
    here = [PROBE, {"name": "drone", "type": "Multirotor"}, *nodes]
    execute(parse({"run": run, "nodes": here}, f"bench {benchmark}"))


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


def ratios(runs: Sequence[Any], beside: Sequence[Any]) -> tuple[float, float]:
    """Return the medians over all pairs of the ratios of their medians and 99th percentiles.

    Lateness is in nanoseconds; `beside` has what each run or window is held against.
    """
    each = [
        np.percentile(late, (50, 99)) / np.percentile(before, (50, 99))
        for late, before in zip(runs, beside, strict=False)
    ]
    p50, p99 = np.median(each, axis=0).tolist()
    return p50, p99


class RecordingRow(LateRow, frozen=True, kw_only=True):
    """Runs of a kind, pooled; `ratio_p99` is the median of the pairs' ratios.

    Attributes:
        frames: Pairs of images received.
        megabytes: Written.
        dropped: Events missing from the recordings.
    """

    case: str
    frames: int
    megabytes: float
    dropped: int


class _Run(msgspec.Struct):
    """Measurements of a run; lateness in nanoseconds."""

    late: list[int] = []
    frames: int = 0
    megabytes: float = 0.0
    dropped: int = 0


WARM_UP = 1_500_000_000  # nanoseconds left out at the start of each run

CASES: dict[str, dict[str, object] | None] = {
    "no recorder": None,
    "recorded, zstd": {"compression": "zstd"},
    "recorded, lz4": {"compression": "lz4"},
}


def measure_recording(
    *,
    seconds: float = 6.0,
    repeats: int = 5,
    rate: float = 30.0,
    progress: Callable[[str], None] = lambda _: None,
) -> list[RecordingRow]:
    """Measure all cases, in turns.

    Args:
        rate: Of the camera, Hz.
    """
    found: dict[str, list[_Run]] = {case: [] for case in CASES}
    for number, case in in_turns(CASES, repeats):
        progress(f"{case}, {number + 1} of {repeats}")
        found[case].append(_measure(CASES[case], seconds, rate))
    late = {case: [run.late for run in runs] for case, runs in found.items()}
    return [
        RecordingRow(
            case=case,
            ratio_p99=ratios(late[case], late["no recorder"])[1],
            frames=sum(run.frames for run in runs),
            megabytes=sum(run.megabytes for run in runs),
            dropped=sum(run.dropped for run in runs),
            **figures(late[case]),
        )
        for case, runs in found.items()
    ]


def _measure(recorder: dict[str, object] | None, seconds: float, rate: float) -> _Run:
    BEATS.clear()
    camera = {"name": "camera", "images": ["rgb", "depth"], "rate": rate}
    nodes: list[dict[str, Any]] = [
        {"name": "drone", "type": "Multirotor", "cameras": [camera]},
        PROBE,
    ]
    if recorder is not None:
        table = {"name": "recorder", "type": "McapRecorder"}
        nodes.insert(0, table | recorder)
    run = {"clock": "real", "duration": seconds, "stall": 0, "log": "fatal"}
    with tempfile.TemporaryDirectory() as folder:
        summary = execute(parse({"run": run, "nodes": nodes}, "bench recording"), Path(folder))
        files = Path(folder).glob("*.mcap")
        megabytes = sum(file.stat().st_size for file in files) / 1e6
    time.sleep(0.5)  # what the last run leaves to do must not fall on the next
    return _Run(
        late=[beat.late for beat in BEATS if beat.stamp > WARM_UP],
        frames=summary.events.get("DepthImage", 0),
        megabytes=megabytes,
        dropped=sum(summary.drops.values()),
    )
