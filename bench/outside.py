"""Cost of an estimator outside the process, against the same estimator in a worker.

The way there: both sides get the same 512×512 RGB-D frame in shared memory and answer without
looking at it; a time is from the call to the answer on the loop.

A whole flight: both fly in lockstep with a 512×512 RGB-D camera at 30 Hz and the same odometry; a
speed is simulated seconds per second. Both say the same: their digests are compared.

Sides take turns, and a ratio is that of the two medians. ``python -m bench.outside`` is the program
outside: with ``answer`` it answers every frame, with ``track`` it is the odometry.
"""

from __future__ import annotations

import asyncio
import functools
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import uvloop

from bench.benchmarks import Progress, Row
from bench.harness import in_turns, pair, paired, program, silent
from bench.lockstep import lockstep_run, random_images
from events import CameraInfo
from nodes.estimators import WORKER_ENVIRONMENT
from nodes.estimators.visual_odometry.node import VisualOdometryConfig, make_tracker
from nodes.outside.native import Endpoint, LinkAnswer
from nodes.outside.native.client import Link
from runtime.summary import Summary
from runtime.time.clock import RealClock
from runtime.workers.worker import Worker

WARM_UP = 30
ESTIMATES = "odometry.estimates"


class Taker:
    """Lives in a worker; takes a frame and gives nothing back."""

    def take(self, colours: npt.NDArray[np.uint8], depth: npt.NDArray[np.float32]) -> None:
        """Take a frame."""


def measure_link(*, samples: int = 1000, progress: Progress = silent) -> list[Row]:
    """Measure an RGB-D frame of 512×512."""
    progress("a frame to a program and back")
    colours, depth = random_images(512)
    size = colours.nbytes + depth.nbytes
    with (
        tempfile.TemporaryDirectory() as folder,
        asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner,
    ):
        path = Path(folder) / "link.socket"
        answers: asyncio.Queue[LinkAnswer] = asyncio.Queue()
        wake = runner.get_loop().call_soon_threadsafe

        def take(answer: LinkAnswer) -> None:
            wake(answers.put_nowait, answer)

        endpoint = Endpoint(
            path,
            {"cameras": [{"body_from_camera": np.eye(4).tolist()}], "inputs": [], "outputs": []},
            slots=2,
            slot_bytes=size,
            answered=take,
            gone=lambda _: None,
            logged=lambda _: None,
        )

        async def by_link() -> None:
            endpoint.send_frame(0, [(0, "rgb8", colours), (0, "depth32f", depth)])
            await answers.get()

        endpoint.listen()
        with program("-m", "bench.outside", "answer", environment={"VISNAV_SOCKET": str(path)}):
            try:
                endpoint.wait(60.0)
                taken = runner.run(_measure(by_link, (colours, depth), samples))
            finally:
                endpoint.close()
    figures = pair(taken)
    shown = {key: figures[key] for key in ("link_us", "worker_us", "ratio")}
    return [{"case": "512×512 rgb8, depth32f", "bytes": size, "samples": samples, **shown}]


async def _measure(
    by_link: Callable[[], Awaitable[None]], frame: tuple[Any, Any], samples: int
) -> dict[str, list[int]]:
    clock = RealClock(asyncio.get_running_loop())
    worker = Worker("taker", clock, Taker, niceness=0)
    try:
        await worker.ready()
        sides: dict[str, Callable[[], Awaitable[None]]] = {
            "link": by_link,
            "worker": lambda: worker.call(Taker.take, *frame),
        }
        taken: dict[str, list[int]] = {side: [] for side in sides}
        for number, side in in_turns(sides, WARM_UP + samples):
            begin = time.perf_counter_ns()
            await sides[side]()
            if number >= WARM_UP:
                taken[side].append(time.perf_counter_ns() - begin)
        return taken
    finally:
        await asyncio.to_thread(worker.close)
        clock.close()


_ESTIMATORS: dict[str, dict[str, Any]] = {
    "outside": {
        "type": "Process",
        "command": [sys.executable, "-m", "bench.outside", "track"],
        "environment": WORKER_ENVIRONMENT,
        "timeout": 120,
    },
    "worker": {"type": "VisualOdometry"},
}


def measure_held(
    *, seconds: float = 8.0, repeats: int = 5, progress: Progress = silent
) -> list[Row]:
    """Measure, interleaved; ``equal`` if all flights had the same estimates at the same times."""
    sides = {
        side: functools.partial(_fly, seconds, estimator) for side, estimator in _ESTIMATORS.items()
    }
    measured = paired(sides, repeats, progress)
    outside, worker = (seconds / median(s.wall_seconds for s in side) for side in measured.values())
    digests = {summary.digests[ESTIMATES] for side in measured.values() for summary in side}
    speeds = {"outside_speed": outside, "worker_speed": worker, "ratio": outside / worker}
    return [{"case": "native interface", "rounds": repeats, **speeds, "equal": len(digests) == 1}]


def _fly(seconds: float, estimator: dict[str, Any]) -> Summary:
    camera = {"name": "camera", "rate": 30, "noise": 2.0, "depth_noise": 0.0015}
    return lockstep_run(
        seconds,
        {"name": "pilot", "type": "bench.lockstep:Pilot"},
        {"name": "drone", "type": "Multirotor", "cameras": [camera]},
        {"name": "odometry", "latency": "15ms", **estimator},
    )


def track() -> None:
    """Track every frame until the run ends."""
    with Link("odometry") as link:
        info = msgspec.convert(link.description["cameras"][0]["info"], CameraInfo)
        tracker = make_tracker(VisualOdometryConfig(), info)
        link.ready()
        for frame in link:
            images = frame.image("rgb8"), frame.image("depth32f")
            tracked = tracker.track(frame.stamp, *images)
            if tracked.lost:
                link.lost(frame, tracked.points)
            else:
                link.pose(frame, tracked.pose, points=tracked.points, inliers=tracked.inliers)


def answer() -> None:
    """Answer every frame until the run ends."""
    with Link("bench") as link:
        link.ready()
        for frame in link:
            link.done(frame)


if __name__ == "__main__":
    {"answer": answer, "track": track}[sys.argv[1]]()
