"""How late a 400 Hz controller gets under a flood of messages from ROS 2.

A multirotor hovers on the real clock, controlled at 400 Hz, with the bridge beside it, which has
subscribed to velocities. Another process sends 10,000 of them a second in every other window of
a second. Each flooded window is compared with the quiet one just before it, and the median of all
such pairs is told: whatever else the machine does falls on both alike, and on few pairs much.

``python -m bench.flood PORT KEY RATE SECONDS WINDOWS`` is the flood. It connects, says ``ready``,
waits for a line on its standard input, and then prints a line for each window: when it began and
ended (monotonic clock, ns) and how many messages it sent. Nothing is dropped on this side. Another
line of input then ends it; a number in it is the size of a last message, that of no twist.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from bench.lateness import LateRow, figures, hover, lateness, ratios
from bench.system import free_port, zenoh_config
from nodes.ros2.bridge.keys import data_key
from nodes.ros2.messages.topics import Topic
from nodes.ros2.messages.typestore import TypeStore

TWIST = "geometry_msgs/msg/Twist"
BURST = 0.001  # seconds between bursts of messages

RATE = 10_000.0
WINDOW = 1.0  # seconds


class FloodRow(LateRow, frozen=True, kw_only=True):
    """Figures of a kind of window; `ratio_p99`: median ratio to paired quiet window.

    Attributes:
        case: ``quiet`` or ``flood``.
        messages_per_second: Received.
        ratio_p50: Median of the pairs' ratios of medians.
    """

    case: str
    messages_per_second: float
    ratio_p50: float


def measure(
    *, windows: int = 30, rate: float = RATE, progress: Callable[[str], None] = lambda _: None
) -> list[FloodRow]:
    """Measure quiet windows and flooded ones, in turns.

    Args:
        windows: Of both kinds together.
        rate: Messages a second of a flood.
    """
    progress(f"{windows} windows of {WINDOW:g} s, every other with {rate:g} messages a second")
    port = free_port()
    found: list[tuple[int, int, int]] = []
    with _flooder(port, rate, windows, found):
        bridge = {
            "name": "ros2",
            "type": "Ros2Bridge",
            "connect": [],
            "listen": [f"tcp/127.0.0.1:{port}"],
            "subscriptions": [{"topic": "/cmd_vel", "type": TWIST, "as": "velocity"}],
        }
        hover("flood", windows * WINDOW + 8.0, bridge)
    quiet, flood = found[0::2], found[1::2]
    return [_row("quiet", quiet, quiet), _row("flood", flood, quiet)]


@contextlib.contextmanager
def _flooder(
    port: int, rate: float, windows: int, found: list[tuple[int, int, int]]
) -> Iterator[None]:
    """Run the flood beside the block; `found` gets begin, end and number sent of each window."""
    type_hash = TypeStore().hash(TWIST)
    key = data_key(0, Topic(name="/cmd_vel", type=TWIST, hash=type_hash))
    words = [str(port), key, str(rate), str(WINDOW), str(windows)]
    command = [sys.executable, "-m", "bench.flood", *words]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        reading = threading.Thread(target=_read, args=(process, found), daemon=True)
        reading.start()
        try:
            yield
        finally:
            process.kill()
            reading.join()


def _read(process: subprocess.Popen[str], found: list[tuple[int, int, int]]) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    for line in process.stdout:
        if line == "ready\n":
            time.sleep(1.0)  # for the vehicle to have taken off
            process.stdin.write("go\n")
            process.stdin.flush()
        else:
            found.append(tuple(json.loads(line)))


def _row(
    case: str, windows: list[tuple[int, int, int]], quiet: list[tuple[int, int, int]]
) -> FloodRow:
    lates, befores = ([lateness(*window[:2]) for window in side] for side in (windows, quiet))
    ratio_p50, ratio_p99 = ratios(lates, befores)
    seconds = sum(end - begin for begin, end, _ in windows) / 1e9
    return FloodRow(
        case=case,
        messages_per_second=sum(sent for *_, sent in windows) / seconds,
        ratio_p50=ratio_p50,
        ratio_p99=ratio_p99,
        **figures(lates),
    )


def main(port: int, key: str, rate: float, seconds: float, windows: int) -> None:
    """Send a flood of messages in every second window; the first window is quiet."""
    store = TypeStore()
    twist = bytes(store.serialize(store.zero(TWIST)))
    with zenoh.open(zenoh_config(connect=f"tcp/127.0.0.1:{port}")) as session:
        publisher: Any = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK
        )
        while not publisher.matching_status.matching:
            time.sleep(0.01)  # until the other side has subscribed
        print("ready", flush=True)
        sys.stdin.readline()
        for window in range(windows):
            begin, sent = time.monotonic_ns(), 0
            while (passed := (time.monotonic_ns() - begin) / 1e9) < seconds:
                if window % 2:
                    for _ in range(round(passed * rate) - sent):
                        publisher.put(twist)
                        sent += 1
                time.sleep(BURST)
            print(json.dumps([begin, time.monotonic_ns(), sent]), flush=True)
        if size := sys.stdin.readline().strip():
            publisher.put(bytes(int(size)))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], float(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]))
