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
from typing import Any

import msgspec
import numpy as np

from bench.lateness import BEATS, PROBE, LateRow, figures
from runtime.config.reading import parse
from runtime.run.execute import execute


class RecordingRow(LateRow, frozen=True, kw_only=True):
    """Runs of one kind; `ratio_p99` is the median of the pairs' ratios.

    Attributes:
        case: Which.
        frames: Pairs of images that came, in all runs.
        megabytes: Written, in all runs.
        dropped: Events that are not in the recordings.
    """

    case: str
    frames: int
    megabytes: float
    dropped: int


class _Run(msgspec.Struct):
    """What one run leaves; lateness in nanoseconds."""

    late: list[int] = []
    frames: int = 0
    megabytes: float = 0.0
    dropped: int = 0


WARM_UP = 1_500_000_000
"""Nanoseconds of each run that are left out."""

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
            ratio_p99=float(
                np.median([_p99(run) / base for run, base in zip(runs, plain, strict=True)])
            ),
            frames=sum(run.frames for run in runs),
            megabytes=sum(run.megabytes for run in runs),
            dropped=sum(run.dropped for run in runs),
            **figures([run.late for run in runs]),
        )
        for case, runs in found.items()
    ]


def _p99(run: _Run) -> float:
    return float(np.percentile(run.late, 99))


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
