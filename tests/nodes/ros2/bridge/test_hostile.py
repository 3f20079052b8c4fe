"""A whole run, and what may come at it from outside: nothing of that ends it."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from nodes.ros2.bridge.keys import data_key
from nodes.ros2.messages.topics import Topic
from tests.nodes.ros2.bridge.network import bridged_run, free_port, zenoh_session
from tests.nodes.ros2.bridge.test_incoming_topic import valid
from tests.nodes.ros2.messages import samples

pytestmark = [pytest.mark.slow, pytest.mark.timeout(150)]

TWIST = "geometry_msgs/msg/Twist"


def key(topic: str, type_: str) -> str:
    return data_key(0, Topic(name=topic, type=type_, hash=samples.store().hash(type_)))


def wait_for(session: zenoh.Session, keys: str, seconds: float = 30.0) -> Any:
    """Return the next sample on some keys."""
    samples: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with session.declare_subscriber(keys, samples.put):
        return samples.get(timeout=seconds)


def clock(sample: Any) -> tuple[int, int]:
    message = samples.store().deserialize(sample.payload.to_bytes(), "rosgraph_msgs/msg/Clock")
    return message.clock.sec, message.clock.nanosec


def end(run: subprocess.Popen[str], folder: Path) -> str:
    """End a run as Ctrl-C would, and return its log."""
    run.send_signal(signal.SIGINT)
    output, _ = run.communicate(timeout=30)
    assert run.returncode == 0, output
    (log,) = folder.rglob("log.txt")
    return log.read_text()


def test_garbage_and_a_flood_are_counted_and_survived(tmp_path: Path) -> None:
    with (
        bridged_run(tmp_path, enough=9, more=FLOODED) as (run, port),
        zenoh_session(connect=f"tcp/127.0.0.1:{port}") as session,
    ):
        wait_for(session, "0/drone/odom/**")
        garbage = session.declare_publisher(key("/slam/pose", "geometry_msgs/msg/PoseStamped"))
        message = valid("geometry_msgs/msg/PoseStamped")
        for bad in (b"", b"\0", message[:20], b"\xff" * 100, valid(TWIST), bytes(2_000_000)):
            garbage.put(bad, attachment=b"neither")
        session.put("0/slam/pose/other::msg::dds_::Type_/RIHS01_0", message)
        flood = session.declare_publisher(key("/cmd_vel", TWIST))
        twist, begin = valid(TWIST), time.monotonic()
        for _ in range(200):
            for _ in range(100):
                flood.put(twist)
            time.sleep(0.01)  # 10,000 a second, or what this machine can do
        sent = wait_for(session, "0/drone/camera/image_raw/**")
        assert len(sent.payload) > 9216
        log = end(run, tmp_path)
        lasted = time.monotonic() - begin
    (heard,) = tmp_path.rglob("heard.json")
    assert "VelocitySetpoint" in json.loads(heard.read_text())
    assert "/slam/pose: not a geometry_msgs/msg/PoseStamped" in log
    assert "/slam/pose: message too large: expected 1000000 bytes or less, found 2000000" in log
    assert "/cmd_vel: too many messages: expected 100 a second or less" in log
    assert log.count("too many messages") <= 2 + lasted / 5
    (line,) = [line for line in log.splitlines() if "messages published" in line]
    count = int(line.partition("dropped); ")[2].split()[0])
    assert 10 <= count <= 20 + 100 * lasted


FLOODED = """
max_message_size = 1_000_000

[[nodes.subscriptions]]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
as = "velocity"
max_rate = 100

[[nodes.subscriptions]]
topic = "/slam/pose"
type = "geometry_msgs/msg/PoseStamped"
as = "estimate"
"""

READER = """
import sys, zenoh, time
c = zenoh.Config()
c.insert_json5("mode", '"peer"')
c.insert_json5("scouting/multicast/enabled", "false")
c.insert_json5("listen/endpoints", "[]")
c.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{sys.argv[1]}"]')
with zenoh.open(c) as session, session.declare_subscriber("**") as all:
    all.recv()
    print("ready", flush=True)
    for _ in all:
        pass
"""


@contextlib.contextmanager
def child(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start a Python process that says when it is ready."""
    process = subprocess.Popen([sys.executable, *arguments], text=True, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_peer_that_vanishes_or_stands_still_holds_up_nobody(
    tmp_path: Path, how: signal.Signals
) -> None:
    with bridged_run(tmp_path, enough=9) as (run, port), child("-c", READER, str(port)) as reader:
        reader.send_signal(how)
        time.sleep(3.0)  # for a queue to fill up, in real time
        with zenoh_session(connect=f"tcp/127.0.0.1:{port}") as session:
            first = wait_for(session, "0/clock/**")
            later = wait_for(session, "0/clock/**")
        log = end(run, tmp_path)
    assert clock(first) < clock(later)
    (summary,) = tmp_path.rglob("summary.json")
    tick = json.loads(summary.read_text())["ticks"]["ros2.publish_clock"]
    assert tick["late_p50_us"] < 50_000, tick  # it would be late by seconds
    assert "ERROR" not in log


def test_a_router_may_go_and_come_back(tmp_path: Path) -> None:
    port = free_port()
    more = f'domain_id = 5\nnode_name = "roamer"\ntopics = {{ "/clock" = "/time" }}\n#{port}'
    with contextlib.ExitStack() as stack:
        router = stack.enter_context(child("-m", "tests.nodes.ros2.bridge.router", str(port)))
        run, _ = stack.enter_context(bridged_run(tmp_path, enough=9, more=more, router=port))
        # As nodes of ROS do, both listen: Zenoh's gossip does not bring those together that do not.
        way = {"connect": f"tcp/127.0.0.1:{port}", "listen": "tcp/127.0.0.1:0"}
        reader = stack.enter_context(zenoh_session(**way))
        wait_for(reader, "5/time/**")
        router.kill()
        router.wait()
        stack.enter_context(child("-m", "tests.nodes.ros2.bridge.router", str(port)))
        late = stack.enter_context(zenoh_session(**way))
        wait_for(late, "5/time/**")
        tokens: queue.SimpleQueue[Any] = queue.SimpleQueue()
        late.liveliness().declare_subscriber("@ros2_lv/5/*/*/*/NN/**", tokens.put, history=True)
        token = str(tokens.get(timeout=30).key_expr)
        end(run, tmp_path)
    assert token.endswith("/NN/%/%/roamer")
