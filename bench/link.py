"""What a frame costs on its way to a program outside, beside the same arrays' way to a worker.

Both sides get the same 512×512 RGB-D frame in shared memory and answer without looking at it; a
time is from the call to the answer on the loop. Samples are taken in turns, in an order that is
drawn each time; a ratio is that of the two medians.

``python -m bench.link`` is the program: it answers until the run ends.
"""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import uvloop

from nodes.outside.native import Endpoint, LinkAnswer
from nodes.outside.native.client import Link
from runtime.time.clock import RealClock
from runtime.workers.worker import Worker

WARM_UP = 30


class LinkRow(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of frame.

    Attributes:
        case: Its images.
        bytes: Of them.
        samples: Of each side.
        link_us: Median microseconds through the native interface and back.
        worker_us: The same of a worker's call.
        ratio: The first to the second.
    """

    case: str
    bytes: int
    samples: int
    link_us: float
    worker_us: float
    ratio: float


class Taker:
    """Lives in a worker; takes a frame and gives nothing back."""

    def take(self, colours: npt.NDArray[np.uint8], depth: npt.NDArray[np.float32]) -> None:
        """Take a frame."""


def measure(samples: int = 1000) -> list[LinkRow]:
    """Measure an RGB-D frame of 512×512."""
    drawn = np.random.default_rng(0)
    colours = drawn.integers(0, 256, (512, 512, 3), np.uint8)
    depth = drawn.uniform(0.3, 20.0, (512, 512)).astype(np.float32)
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
            {"cameras": [{"body_from_camera": np.eye(4).tolist()}]},
            slots=2,
            slot_bytes=colours.nbytes + depth.nbytes,
            answered=take,
            gone=lambda _: None,
            logged=lambda _: None,
        )

        async def by_link() -> None:
            endpoint.send_frame(0, [(0, "rgb8", colours), (0, "depth32f", depth)])
            await answers.get()

        endpoint.listen()
        environment = {**os.environ, "VISNAV_SOCKET": str(path)}
        with subprocess.Popen([sys.executable, "-m", "bench.link"], env=environment):
            try:
                endpoint.wait(60.0)
                times = runner.run(_measure(by_link, (colours, depth), samples))
            finally:
                endpoint.close()
    link, worker = np.median(times, axis=1) / 1e3
    size = colours.nbytes + depth.nbytes
    case = "512×512 rgb8, depth32f"
    microseconds = {"link_us": link, "worker_us": worker, "ratio": link / worker}
    return [LinkRow(case=case, bytes=size, samples=samples, **microseconds)]


async def _measure(
    by_link: Callable[[], Awaitable[None]], frame: tuple[Any, Any], samples: int
) -> list[list[int]]:
    """Return the times (ns) through the link and by a worker."""
    clock = RealClock(asyncio.get_running_loop())
    worker = Worker("taker", clock, Taker, niceness=0)
    try:
        await worker.ready()
        return await _in_turns([by_link, lambda: worker.call(Taker.take, *frame)], samples)
    finally:
        await asyncio.to_thread(worker.close)
        clock.close()


async def _in_turns(sides: list[Callable[[], Awaitable[None]]], samples: int) -> list[list[int]]:
    """Return each side's times (ns)."""
    taken: list[list[int]] = [[] for _ in sides]
    order = list(range(len(sides)))
    shuffle = random.Random(0).shuffle
    for _ in range(WARM_UP + samples):
        shuffle(order)
        for side in order:
            begin = time.perf_counter_ns()
            await sides[side]()
            taken[side].append(time.perf_counter_ns() - begin)
    return [times[WARM_UP:] for times in taken]


def main() -> None:
    """Answer every frame until the run ends."""
    with Link("bench") as link:
        link.ready()
        for frame in link:
            link.done(frame)


if __name__ == "__main__":
    main()
