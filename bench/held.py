"""A flight with the same odometry twice: in a worker, and in a program for which time is held.

Both fly in lockstep with a 512×512 RGB-D camera at 30 Hz, in turns; a speed is simulated seconds
per second, and the ratio that of the two medians. Both say the same: their digests are compared.

``python -m bench.held`` is the program.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from statistics import median
from typing import Any

import msgspec

from events import CameraInfo
from nodes.estimators import WORKER_ENVIRONMENT
from nodes.estimators.visual_odometry.node import VisualOdometryConfig, make_tracker
from nodes.outside.native.client import Link
from runtime.config.reading import parse
from runtime.run.execute import execute
from runtime.summary import Summary

ESTIMATES = "odometry.estimates"


class HeldRow(msgspec.Struct, frozen=True, kw_only=True):
    """One way to a program outside.

    Attributes:
        case: Which.
        rounds: Flights of each side.
        outside_speed: Simulated seconds per second with the program, median.
        worker_speed: The same with a worker.
        ratio: The first to the second.
        equal: Whether all flights had the same estimates at the same times.
    """

    case: str
    rounds: int
    outside_speed: float
    worker_speed: float
    ratio: float
    equal: bool


def measure(
    *, seconds: float = 8.0, repeats: int = 5, progress: Callable[[str], None] = lambda _: None
) -> list[HeldRow]:
    """Measure, interleaved.

    Args:
        progress: Called with what is being measured.
    """
    outside: list[Summary] = []
    worker: list[Summary] = []
    for round_ in range(repeats):
        progress(f"held: round {round_ + 1} of {repeats}")
        sides = [(outside, _OUTSIDE), (worker, _WORKER)]
        for found, estimator in sides if round_ % 2 else sides[::-1]:
            found.append(_fly(seconds, estimator))
    speeds = [seconds / median(s.wall_seconds for s in side) for side in (outside, worker)]
    said = {summary.digests[ESTIMATES] for summary in outside + worker}
    return [
        HeldRow(
            case="native interface",
            rounds=repeats,
            outside_speed=speeds[0],
            worker_speed=speeds[1],
            ratio=speeds[0] / speeds[1],
            equal=len(said) == 1,
        )
    ]


_WORKER: dict[str, Any] = {"type": "VisualOdometry"}
_OUTSIDE: dict[str, Any] = {
    "type": "Process",
    "command": [sys.executable, "-m", "bench.held"],
    "environment": WORKER_ENVIRONMENT,
    "timeout": 120,
}


def _fly(seconds: float, estimator: dict[str, Any]) -> Summary:
    run = {"duration": seconds, "log": "error", "stall": 1}
    camera = {"name": "camera", "rate": 30, "noise": 2.0, "depth_noise": 0.0015}
    nodes = [
        {"name": "pilot", "type": "bench.lockstep:Pilot"},
        {"name": "drone", "type": "Multirotor", "cameras": [camera]},
        {"name": "odometry", "latency": "15ms", **estimator},
    ]
    return execute(parse({"run": run, "nodes": nodes}, "bench held"))


def main() -> None:
    """Track every frame until the run ends."""
    with Link("odometry") as link:
        info = msgspec.convert(link.description["cameras"][0]["info"], CameraInfo)
        tracker = make_tracker(VisualOdometryConfig(), info)
        link.ready()
        for frame in link:
            images = frame.image("rgb8"), frame.image("depth32f")
            found = tracker.track(frame.stamp, *images)
            if found.lost:
                link.lost(frame, found.points)
            else:
                link.pose(frame, found.pose, points=found.points, inliers=found.inliers)


if __name__ == "__main__":
    main()
