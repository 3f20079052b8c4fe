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

import json
import sys
import time
from typing import Any

import zenoh

from bench.benchmarks import Progress, Row
from bench.harness import silent
from bench.lateness import WINDOW, Window, figures, lateness, ratios, windows_beside
from bench.system import free_port, zenoh_session
from nodes.ros2.bridge.keys import data_key
from nodes.ros2.messages.topics import Topic
from nodes.ros2.messages.typestore import TypeStore

TWIST = "geometry_msgs/msg/Twist"
BURST = 0.001  # seconds between bursts of messages


def measure(*, windows: int = 30, rate: float = 10_000.0, progress: Progress = silent) -> list[Row]:
    """Measure quiet windows and flooded ones, in turns.

    Args:
        windows: Of both kinds together.
        rate: Messages a second of a flood.
    """
    progress(f"{windows} windows of {WINDOW:g} s, every other with {rate:g} messages a second")
    port = free_port()
    bridge = {
        "name": "ros2",
        "type": "Ros2Bridge",
        "connect": [],
        "listen": [f"tcp/127.0.0.1:{port}"],
        "subscriptions": [{"topic": "/cmd_vel", "type": TWIST, "as": "velocity"}],
    }
    key = data_key(0, Topic(name="/cmd_vel", type=TWIST, hash=TypeStore().hash(TWIST)))
    words = (port, key, rate, WINDOW, windows)
    quiet, flood = windows_beside("bench.flood", words, windows * WINDOW + 8.0, bridge)
    return [_row("quiet", quiet, quiet), _row("flood", flood, quiet)]


def _row(case: str, windows: list[Window], quiet: list[Window]) -> Row:
    lates, befores = ([*map(lateness, side)] for side in (windows, quiet))
    seconds = sum(window.end - window.begin for window in windows) / 1e9
    return {
        **figures(lates, befores),
        "case": case,
        "messages_per_second": sum(window.measured for window in windows) / seconds,
        "ratio_p50": ratios(lates, befores)[0],
    }


def main(port: int, key: str, rate: float, seconds: float, windows: int) -> None:
    """Send a flood of messages in every second window; the first window is quiet."""
    store = TypeStore()
    twist = bytes(store.serialize(store.zero(TWIST)))
    with zenoh_session(connect=f"tcp/127.0.0.1:{port}") as session:
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
