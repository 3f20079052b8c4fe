"""How quickly the server for AirSim's scripts answers, and how late a 400 Hz tick is meanwhile.

A multirotor hovers on the real clock with the server beside it. A client in another process asks
for one thing as quickly as it is answered, in every other window of a second: a ping, a vehicle's
state, an image, each in turns. Each such window is compared with the quiet one just before it,
and the median of all such pairs is told, as in `bench.flood`.

``python -m bench.airsim PORT ROUNDS`` is the client: it prints a line for each window, with the
round trips (ns).
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from typing import Any

import msgspec
import numpy as np

from bench.benchmarks import Progress, Row
from bench.harness import silent
from bench.lateness import WINDOW, Window, figures, lateness, windows_beside
from bench.system import free_port
from visnav_airsim.client.connection import RpcClient
from visnav_airsim.wire import ImageRequest

START = 12.0  # seconds from the start of the run until the first window at the latest

IMAGE = ImageRequest("0", 0, False, False)
CASES: dict[str, tuple[Any, ...]] = {
    "ping": ("ping",),
    "state": ("getMultirotorState", ""),
    "image, 256×144 uncompressed": ("simGetImages", [IMAGE], "", False),
}
"""AirSim requests to measure, by their names in the results."""


def measure(*, rounds: int = 10, progress: Progress = silent) -> list[Row]:
    """Measure quiet windows and others, in turns."""
    count = rounds * len(CASES)
    progress(f"airsim: {2 * count} windows of {WINDOW:g} s")
    server = {"name": "airsim", "type": "AirsimServer", "port": free_port()}
    words = (server["port"], rounds)
    quiet, busy = windows_beside("bench.airsim", words, 2 * count * WINDOW + START, server)
    if len(busy) < count:
        raise RuntimeError(f"expected {count} busy windows, found {len(busy)}")
    late = [*map(lateness, quiet)]
    nothing = {"per_second": None, "median_us": None, "p99_us": None}
    rows: list[Row] = [{**figures(late, late), "case": "quiet", **nothing}]
    for index, case in enumerate(CASES):
        rows.append(_row(case, busy[index :: len(CASES)], late[index :: len(CASES)]))
    return rows


def _row(case: str, windows: list[Window], quiet: list[Any]) -> Row:
    trips = np.concatenate([window.measured for window in windows]) / 1e3
    seconds = sum(window.end - window.begin for window in windows) / 1e9
    return {
        **figures([*map(lateness, windows)], quiet),
        "case": case,
        "per_second": len(trips) / seconds,
        "median_us": float(np.median(trips)),
        "p99_us": float(np.percentile(trips, 99)),
    }


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
