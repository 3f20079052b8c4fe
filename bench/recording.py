"""What a recorder costs a 400 Hz controller, and what a replay needs: paired, in real time.

A multirotor hovers on the real clock, controlled at 400 Hz, with a 512×512 RGB-D camera at 30 Hz.
Runs with the recorder and without alternate, and those of a pair stand side by side, so that
whatever else the machine does falls on both alike; the ratio is the median of the pairs' ratios.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from bench.takeoff import TakeoffNode
from runtime import NodeConfig, Tick, every
from runtime.config.reading import parse
from runtime.execute import execute


class RecordingRow(msgspec.Struct, frozen=True, kw_only=True):
    """Runs of one kind.

    Attributes:
        case: Which.
        ticks: How many were measured.
        late_p50_us: Median lateness of the 400 Hz tick, microseconds.
        late_p99_us: Its 99th percentile: the median of the runs'.
        late_max_us: Its maximum.
        ratio_p99: Median of the pairs' ratios of 99th percentiles, to the run without a recorder.
        frames: Pairs of images that came, in all runs.
        megabytes: Written, in all runs.
        dropped: Events that are not in the recordings.
    """

    case: str
    ticks: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    ratio_p99: float
    frames: int
    megabytes: float
    dropped: int


class _Run(msgspec.Struct):
    """What one run leaves; lateness in nanoseconds."""

    late: list[int] = []
    frames: int = 0
    megabytes: float = 0.0
    dropped: int = 0


_run = _Run()


class ProbeConfig(NodeConfig):
    """Settings of the probe."""

    warm_up: float = 1.5


class Probe(TakeoffNode[ProbeConfig]):
    """Measures how late a 400 Hz tick comes, and sends the vehicle up."""

    @every(hz=400)
    def tick(self, tick: Tick) -> None:
        """Note how late it is."""
        if tick.stamp > self.config.warm_up * 1e9:
            _run.late.append(tick.late)


CASES: dict[str, dict[str, object] | None] = {
    "no recorder": None,
    "recorded, zstd": {"compression": "zstd"},
    "recorded, lz4": {"compression": "lz4"},
}


def measure(
    *,
    seconds: float = 6.0,
    repeats: int = 5,
    rate: float = 30.0,
    progress: Callable[[str], None] = lambda _: None,
) -> list[RecordingRow]:
    """Measure all cases, in turns.

    Args:
        seconds: Of each run.
        repeats: Runs of each case.
        rate: Of the camera, Hz.
        progress: Called with what is measured.
    """
    found: dict[str, list[_Run]] = {case: [] for case in CASES}
    for number in range(repeats):
        for case in list(CASES)[:: 1 if number % 2 else -1]:
            progress(f"{case}, {number + 1} of {repeats}")
            found[case].append(_measure(CASES[case], seconds, rate))
    plain = [_p99(run) for run in found["no recorder"]]
    return [
        RecordingRow(
            case=case,
            ticks=sum(len(run.late) for run in runs),
            late_p50_us=float(np.median(np.concatenate([run.late for run in runs]))) / 1e3,
            late_p99_us=float(np.median([_p99(run) for run in runs])) / 1e3,
            late_max_us=max(max(run.late) for run in runs) / 1e3,
            ratio_p99=float(
                np.median([_p99(run) / base for run, base in zip(runs, plain, strict=True)])
            ),
            frames=sum(run.frames for run in runs),
            megabytes=sum(run.megabytes for run in runs),
            dropped=sum(run.dropped for run in runs),
        )
        for case, runs in found.items()
    ]


def _p99(run: _Run) -> float:
    return float(np.percentile(run.late, 99))


def _measure(recorder: dict[str, object] | None, seconds: float, rate: float) -> _Run:
    global _run
    _run = _Run(late=[])
    camera = {"name": "camera", "images": ["rgb", "depth"], "rate": rate}
    nodes: list[dict[str, object]] = [
        {"name": "drone", "type": "sims.multirotor:Multirotor", "cameras": [camera]},
        {"name": "probe", "type": "bench.recording:Probe"},
    ]
    if recorder is not None:
        table = {"name": "recorder", "type": "nodes.mcap_recorder:McapRecorder"}
        nodes.insert(0, table | recorder)
    run = {"clock": "real", "duration": seconds, "stall": 0, "log": "fatal"}
    with tempfile.TemporaryDirectory() as folder:
        summary = execute(parse({"run": run, "nodes": nodes}, "bench recording"), Path(folder))
        files = Path(folder).glob("*.mcap")
        _run.megabytes = sum(file.stat().st_size for file in files) / 1e6
    _run.frames = summary.events.get("DepthImage", 0)
    _run.dropped = sum(summary.drops.values())
    time.sleep(0.5)  # what the last run leaves to do must not fall on the next
    return _run
