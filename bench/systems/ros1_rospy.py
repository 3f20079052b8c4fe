"""Node of the exchange in rospy, run by Debian's Python, without any package of ours.

``/usr/bin/python3 -P ros1_rospy.py ping CASE NODES SAMPLES WARM_UP OUT`` or ``… listen NUMBER``

Publishers write in the thread that publishes (rospy's ``queue_size=None``), which saves a change of
threads for each message; payloads are NumPy arrays at both ends (``rospy.numpy_msg``).
"""

from __future__ import annotations

import gc
import sys
import threading
import time
import warnings
from typing import Any

PING = "uint32 sender\nuint32 receiver\nint64 number\nint64 stamp\nfloat32[] payload\n"
PONG = "uint32 sender\nuint32 receiver\nint64 number\nint64 stamp\n"

EVERYBODY = 0  # receiver of the last ping, whose number is the count of those before
HELLO = -1  # number of pings before the exchange
TIMEOUT = 10.0  # seconds to wait for a pong

FLOATS = 1080 * 1080


def main() -> int:
    """Run node 1 or another node."""
    import rospy  # type: ignore[import-not-found]
    from genpy.dynamic import generate_dynamic  # type: ignore[import-not-found]
    from rospy.numpy_msg import numpy_msg  # type: ignore[import-not-found]

    warnings.filterwarnings("ignore", message=".*queue_size.*", category=SyntaxWarning)
    ping = numpy_msg(generate_dynamic("bench_msgs/Ping", PING)["bench_msgs/Ping"])
    pong = generate_dynamic("bench_msgs/Pong", PONG)["bench_msgs/Pong"]
    role, *rest = sys.argv[1:]
    name = "node_1" if role == "ping" else f"node_{rest[0]}"
    rospy.init_node(name, disable_rosout=True, disable_signals=True)
    gc.collect()
    gc.freeze()
    if role == "ping":
        be_pinger(rospy, ping, pong, *rest)
        return 0
    return be_listener(rospy, ping, pong, int(rest[0]))


def be_listener(rospy: Any, ping_type: Any, pong_type: Any, node: int) -> int:
    """Hear pings, and reply to those for this node, until the last; return an exit code."""
    pongs = rospy.Publisher("pong", pong_type, tcp_nodelay=True)
    done = threading.Event()
    heard = expected = 0

    def on_ping(ping: Any) -> None:
        nonlocal heard, expected
        if ping.receiver == EVERYBODY:
            expected = ping.number
            done.set()
            return
        if ping.receiver == node:
            pongs.publish(node, ping.sender, ping.number, ping.stamp)
        if ping.number != HELLO:
            heard += 1

    rospy.Subscriber("ping", ping_type, on_ping, tcp_nodelay=True)
    done.wait()
    if heard == expected:
        return 0
    print(f"node {node}: expected to hear {expected} pings, heard {heard}", file=sys.stderr)
    return 1


def be_pinger(
    rospy: Any,
    ping_type: Any,
    pong_type: Any,
    case: str,
    nodes: str,
    samples: str,
    warm_up: str,
    out: str,
) -> None:
    """Measure as node 1, and write the samples to `out` as raw int64."""
    import numpy as np

    receiver = int(nodes)
    taken = np.zeros(int(warm_up) + int(samples), np.int64)
    array = np.arange(0 if case == "small" else FLOATS, dtype=np.float32)
    copied = case == "large"
    now = time.perf_counter_ns
    came = threading.Event()
    arrived, ponged = 0, None

    def on_pong(pong: Any) -> None:
        nonlocal arrived, ponged
        arrived = now()
        ponged = pong.number
        came.set()

    pings = rospy.Publisher("ping", ping_type, tcp_nodelay=True)
    rospy.Subscriber("pong", pong_type, on_pong, tcp_nodelay=True)
    deadline = now() + 2 * TIMEOUT * 1e9
    while pings.get_num_connections() < receiver - 1 or ponged is None:
        if now() > deadline:
            raise RuntimeError(f"{pings.get_num_connections()} of {receiver - 1} subscribers came")
        if pings.get_num_connections() == receiver - 1:
            pings.publish(1, receiver, HELLO, 0, array[:0])
        came.wait(0.1)
    for number in range(len(taken)):
        begin = now()
        pings.publish(1, receiver, number, begin, array.copy() if copied else array)
        while ponged != number:
            if not came.wait(TIMEOUT):
                raise RuntimeError(f"no pong for ping {number}")
            came.clear()
        taken[number] = arrived - begin
    taken[int(warm_up) :].tofile(out)
    pings.publish(1, EVERYBODY, len(taken), 0, array[:0])
    deadline = now() + TIMEOUT * 1e9
    while pings.get_num_connections() and now() < deadline:
        time.sleep(0.01)


if __name__ == "__main__":
    sys.exit(main())
