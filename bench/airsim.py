"""How quickly the server for AirSim's scripts answers, and how late a 400 Hz tick is meanwhile.

A multirotor hovers on the real clock with the server beside it. A client in another process asks
for one thing as quickly as it is answered, in every other window of a second: a ping, a vehicle's
state, an image, each in turns. Each such window is compared with the quiet one just before it,
and the median of all such pairs is told, as in `bench.flood`.

``python -m bench.airsim PORT ROUNDS`` is the client: it prints a line for each window.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from bench.lateness import LateRow, figures, hover, lateness, ratios
from bench.system import free_port
from sims.airsim.client.connection import RpcClient
from sims.airsim.wire import ImageRequest

WINDOW = 1.0  # seconds
START = 12.0  # seconds from the start of the run until the first window at the latest

IMAGE = ImageRequest("0", 0, False, False)
CASES: dict[str, tuple[Any, ...]] = {
    "ping": ("ping",),
    "state": ("getMultirotorState", ""),
    "image, 256×144 uncompressed": ("simGetImages", [IMAGE], "", False),
}
"""AirSim requests to measure, by their names in the results."""


class AirsimRow(LateRow, frozen=True, kw_only=True):
    """Figures of a kind of window; `ratio_p99`: median ratio to paired quiet window.

    Attributes:
        case: ``quiet``, or the request.
        per_second: Answers.
        median_us: Round trip as the client sees it; so `p99_us`.
    """

    case: str
    per_second: float | None = None
    median_us: float | None = None
    p99_us: float | None = None


class Window(NamedTuple):
    """When a window began and ended (monotonic clock, ns), and its round trips (ns)."""

    begin: int
    end: int
    round_trips: list[int]


def measure(
    *, rounds: int = 10, progress: Callable[[str], None] = lambda _: None
) -> list[AirsimRow]:
    """Measure quiet windows and others, in turns."""
    progress(f"airsim: {2 * rounds * len(CASES)} windows of {WINDOW:g} s")
    port = free_port()
    windows: list[Window] = []
    command = [sys.executable, "-m", "bench.airsim", str(port), str(rounds)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        lines = client.stdout
        reading = threading.Thread(
            target=lambda: windows.extend(Window(*json.loads(line)) for line in lines)
        )
        reading.start()
        seconds = 2 * rounds * len(CASES) * WINDOW + START
        hover("airsim", seconds, {"name": "airsim", "type": "AirsimServer", "port": port})
        reading.join()
    quiet, busy = windows[0::2], windows[1::2]
    if len(busy) < rounds * len(CASES):
        raise RuntimeError(f"expected {rounds * len(CASES)} busy windows, found {len(busy)}")
    late = [lateness(window.begin, window.end) for window in quiet]
    rows = [AirsimRow(case="quiet", **figures(late))]
    for index, case in enumerate(CASES):
        rows.append(_row(case, busy[index :: len(CASES)], late[index :: len(CASES)]))
    return rows


def _row(case: str, windows: list[Window], quiet: list[Any]) -> AirsimRow:
    late = [lateness(window.begin, window.end) for window in windows]
    trips = np.concatenate([window.round_trips for window in windows]) / 1e3
    seconds = sum(window.end - window.begin for window in windows) / 1e9
    return AirsimRow(
        case=case,
        per_second=len(trips) / seconds,
        median_us=float(np.median(trips)),
        p99_us=float(np.percentile(trips, 99)),
        ratio_p99=ratios(late, quiet)[1],
        **figures(late),
    )


async def ask(port: int, rounds: int) -> None:
    """Ask in every second window, and print each."""
    client = await _connect(port)
    calls = {case: msgspec.to_builtins(call) for case, call in CASES.items()}
    for call in calls.values():
        await client.send(*call)
    await asyncio.sleep(1.0)  # for the vehicle to have taken off
    for _ in range(rounds):
        for call in calls.values():
            for words in ((), call):
                print(json.dumps(await _window(client, words)), flush=True)
    client.close()


async def _window(client: RpcClient, call: tuple[Any, ...]) -> Window:
    begin = now = time.monotonic_ns()
    if not call:
        await asyncio.sleep(WINDOW)
        return Window(begin, time.monotonic_ns(), [])
    trips = []
    while now - begin < WINDOW * 1e9:
        await client.send(*call)
        now, before = time.monotonic_ns(), now
        trips.append(now - before)
    return Window(begin, now, trips)


async def _connect(port: int) -> RpcClient:
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(120.0):
        while True:
            try:
                connected = await loop.create_connection(RpcClient, "127.0.0.1", port)
                return connected[1]
            except OSError:
                await asyncio.sleep(0.1)


if __name__ == "__main__":
    asyncio.run(ask(int(sys.argv[1]), int(sys.argv[2])))
