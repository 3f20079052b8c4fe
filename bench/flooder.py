"""Floods a topic of ROS 2 over Zenoh, in a process of its own: some time on, some time off.

``python -m bench.flooder PORT KEY RATE SECONDS WINDOWS`` connects, says ``ready``, waits for a
line on its standard input, and then prints a line for each window: when it began and ended
(monotonic clock, ns) and how many messages it sent. Nothing is dropped on this side. Another line
of input then ends it; a number in it is the size of a last message, that of no twist.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import zenoh

from nodes.ros2.messages.typestore import TypeStore

TWIST = "geometry_msgs/msg/Twist"
BURST = 0.001
"""Seconds from one handful of messages to the next."""


def main(port: int, key: str, rate: float, seconds: float, windows: int) -> None:
    """Send in every second of so many windows, the first of which is quiet."""
    store = TypeStore()
    twist = bytes(store.serialize(store.zero(TWIST)))
    configuration = zenoh.Config()
    for name, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
    }.items():
        configuration.insert_json5(name, json.dumps(value))
    with zenoh.open(configuration) as session:
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
