"""Runs and clients in processes of their own, on ports of the loopback, for a limited time."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

RUN = """
[run]
name = "bridged"
clock = "real"
duration = "{seconds}s"
stall = 0

[[nodes]]
name = "talker"
type = "tests.nodes.ros2.bridge.talker:Talker"
enough = {enough}

[[nodes]]
name = "ros2"
type = "Ros2Bridge"
connect = {connect}
listen = ["tcp/127.0.0.1:{port}"]
{more}
"""

SUBSCRIPTIONS = """
compressed_images = "jpeg"
compressed_depth = "inverse"

[[nodes.publications]]
topic = "battery"
type = "sensor_msgs/msg/BatteryState"
event = "tests.nodes.ros2.bridge.mappings:Battery"
mapping = "tests.nodes.ros2.bridge.mappings:make_battery"
[[nodes.subscriptions]]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
as = "velocity"

[[nodes.subscriptions]]
topic = "/slam/pose"
type = "geometry_msgs/msg/PoseStamped"
as = "estimate"
source = "slam"
"""


def free_port() -> int:
    """Return a port of the loopback that nobody had a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def bridged_run(
    folder: Path,
    *,
    seconds: float = 60.0,
    enough: int = 2,
    more: str = SUBSCRIPTIONS,
    router: int | None = None,
) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Start a run with the talker and the bridge; yield it and the port that it listens on."""
    port = free_port()
    file = folder.with_name(f"{folder.name}.toml")  # a run takes an empty folder only
    connect = [] if router is None else [f"tcp/127.0.0.1:{router}"]
    settings = {"seconds": seconds, "enough": enough, "port": port, "more": more}
    file.write_text(RUN.format(connect=json.dumps(connect), **settings))
    command = [sys.executable, "-m", "runtime", "run", str(file), "--out", str(folder)]
    run = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        yield run, port
    finally:
        run.kill()
        run.communicate()


def client(port: int, topics: int, seconds: float = 30.0) -> Any:
    """Run the client that nobody here wrote, and return what it saw of so many topics."""
    ended = subprocess.run(
        [sys.executable, "-m", f"{__package__}.sdk_client", str(port), str(seconds), str(topics)],
        capture_output=True,
        text=True,
        timeout=seconds + 20.0,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


@contextlib.contextmanager
def zenoh_session(**endpoints: str) -> Iterator[zenoh.Session]:
    """Open a plain Zenoh session that finds nobody but by an endpoint (``connect``, ``listen``)."""
    configuration = zenoh.Config()
    configuration.insert_json5("mode", '"peer"')
    configuration.insert_json5("scouting/multicast/enabled", "false")
    configuration.insert_json5("timestamping/enabled", "true")
    for way in ("listen", "connect"):
        locators = [endpoints[way]] if way in endpoints else []
        configuration.insert_json5(f"{way}/endpoints", json.dumps(locators))
    with zenoh.open(configuration) as session:
        yield session
