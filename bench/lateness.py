"""Lateness of a 400 Hz tick while a multirotor hovers, for several benchmarks.

Here: the cost of a recorder to such a controller, with a 512×512 RGB-D camera at 30 Hz, on the real
clock. Runs with a recorder and without take turns, and the ratio is the median of the pairs'.
"""

from __future__ import annotations

import functools
import json
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from bench.benchmarks import Progress, Row
from bench.harness import lines_of, paired, program, silent
from events import Takeoff
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.config.reading import parse
from runtime.run.execute import execute

C = TypeVar("C", bound=NodeConfig)

EDGE_NS = 30_000_000
"""Margin at both ends of a window whose ticks are left out, ns: messages may be late."""

WINDOW = 1.0  # seconds


class Beat(NamedTuple):
    """Tick: stamp, arrival (monotonic clock, ns), lateness (ns), count of missed ticks."""

    stamp: int
    at: int
    late: int
    missed: int


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


class Window(NamedTuple):
    """Window of time: begin and end (monotonic clock, ns), and what a program tells of it."""

    begin: int
    end: int
    measured: Any


def windows_beside(
    module: str, words: Sequence[object], seconds: float, node: dict[str, Any]
) -> tuple[list[Window], list[Window]]:
    """Hover while a program has quiet windows and busy ones in turns; return both.

    The program prints a line for each window, as JSON. One that says ``ready`` gets a line as soon
    as the vehicle has taken off.
    """
    windows: list[Window] = []
    with program("-m", module, *words) as beside:
        reading = threading.Thread(target=_read, args=(beside, windows), daemon=True)
        reading.start()
        hover(module.rpartition(".")[2], seconds, node)
        beside.kill()
        reading.join()
    return windows[0::2], windows[1::2]


def _read(process: Any, windows: list[Window]) -> None:
    for line in lines_of(process):
        if line == "ready\n":
            time.sleep(1.0)  # for the vehicle to have taken off
            process.stdin.write("go\n")
            process.stdin.flush()
        else:
            windows.append(Window(*json.loads(line)))


def figures(runs: Sequence[Any], beside: Sequence[Any]) -> Row:
    """Return figures of runs or windows, held against others; lateness is in nanoseconds.

    ``late_p99_us`` is the median of the runs' 99th percentiles; ``ratio_p99`` is as of `ratios`.
    """
    late = np.concatenate(runs) / 1e3
    return {
        "ticks": len(late),
        "late_p50_us": float(np.median(late)),
        "late_p99_us": float(np.median([np.percentile(run, 99) for run in runs])) / 1e3,
        "late_max_us": float(late.max()),
        "ratio_p99": ratios(runs, beside)[1],
    }


def lateness(window: Window) -> npt.NDArray[np.float64]:
    """Return how late the ticks of a window were, nanoseconds."""
    begin, end = window.begin + EDGE_NS, window.end - EDGE_NS
    return np.array([beat.late for beat in BEATS if begin < beat.at < end], np.float64)


def ratios(runs: Sequence[Any], beside: Sequence[Any]) -> tuple[float, float]:
    """Return the medians over all pairs of the ratios of their medians and 99th percentiles.

    Lateness is in nanoseconds; `beside` has what each run or window is held against.
    """
    quotients = [
        np.percentile(late, (50, 99)) / np.percentile(before, (50, 99))
        for late, before in zip(runs, beside, strict=False)
    ]
    p50, p99 = np.median(quotients, axis=0).tolist()
    return p50, p99


WARM_UP = 1_500_000_000  # nanoseconds left out at the start of each run

CASES: dict[str, list[dict[str, Any]]] = {
    "no recorder": [],
    "recorded, zstd": [{"name": "recorder", "type": "McapRecorder", "compression": "zstd"}],
    "recorded, lz4": [{"name": "recorder", "type": "McapRecorder", "compression": "lz4"}],
}


def measure_recording(
    *, seconds: float = 6.0, repeats: int = 5, rate: float = 30.0, progress: Progress = silent
) -> list[Row]:
    """Measure all cases, in turns.

    Args:
        rate: Of the camera, Hz.
    """
    sides = {
        case: functools.partial(_record, recorder, seconds, rate)
        for case, recorder in CASES.items()
    }
    measured = paired(sides, repeats, progress)
    late = {case: [lates for lates, _ in runs] for case, runs in measured.items()}
    return [
        {
            **figures(late[case], late["no recorder"]),
            "case": case,
            **{key: sum(counts[key] for _, counts in runs) for key in runs[0][1]},
        }
        for case, runs in measured.items()
    ]


def _record(recorder: list[dict[str, Any]], seconds: float, rate: float) -> tuple[list[int], Row]:
    """Return the lateness of a run's ticks (ns), and pairs of images, megabytes and drops."""
    BEATS.clear()
    camera = {"name": "camera", "images": ["rgb", "depth"], "rate": rate}
    drone = {"name": "drone", "type": "Multirotor", "cameras": [camera]}
    run = {"clock": "real", "duration": seconds, "stall": 0, "log": "fatal"}
    config = parse({"run": run, "nodes": [*recorder, drone, PROBE]}, "bench recording")
    with tempfile.TemporaryDirectory() as folder:
        summary = execute(config, Path(folder))
        files = Path(folder).glob("*.mcap")
        megabytes = sum(file.stat().st_size for file in files) / 1e6
    time.sleep(0.5)  # what the last run leaves to do must not fall on the next
    return [beat.late for beat in BEATS if beat.stamp > WARM_UP], {
        "frames": summary.events.get("DepthImage", 0),
        "megabytes": megabytes,
        "dropped": sum(summary.drops.values()),
    }
