"""A flood from another process: each message is heard, or counted as refused or dropped."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.flood import TWIST
from nodes.ros2.bridge.keys import data_key
from nodes.ros2.messages.topics import Topic
from tests.nodes.ros2.bridge.network import bridged_run
from tests.nodes.ros2.messages import samples

pytestmark = [pytest.mark.slow, pytest.mark.timeout(150)]

MORE = """
max_message_size = 1000
[[nodes.subscriptions]]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
as = "velocity"
max_rate = {rate}
"""


@pytest.mark.parametrize("rate", [100.0, 100_000.0])
def test_what_was_sent_is_what_was_heard_and_what_was_dropped(rate: float, tmp_path: Path) -> None:
    """At a rate that refuses most, and at one that lets all wait."""
    key = data_key(0, Topic(name="/cmd_vel", type=TWIST, hash=samples.store().hash(TWIST)))
    with bridged_run(tmp_path, enough=9, more=MORE.format(rate=rate)) as (run, port):
        command = [sys.executable, "-m", "bench.flood", str(port), key, "10000", "1", "4"]
        flooder = subprocess.run(
            command, input="go\n2000\n", capture_output=True, text=True, timeout=60, check=True
        )
        windows = [json.loads(line) for line in flooder.stdout.splitlines()[1:]]
        wait_for_line(tmp_path, "/cmd_vel: message too large")  # the last one
        seconds = (time.monotonic_ns() - windows[1][0]) / 1e9
        run.send_signal(signal.SIGINT)
        output, _ = run.communicate(timeout=30)
        assert run.returncode == 0, output
    sent = [count for _, _, count in windows]
    assert sent[0] == sent[2] == 0
    assert min(sent[1], sent[3]) > 0
    (log,) = tmp_path.rglob("log.txt")
    match = re.search(r"(\d+) received, (\d+) refused or dropped", log.read_text())
    assert match is not None
    heard, refused = map(int, match.groups())
    assert heard + refused == sum(sent) + 1
    assert 10 <= heard <= 10 + rate * seconds


def wait_for_line(folder: Path, words: str, seconds: float = 30.0) -> None:
    """Wait until a run's log has these words."""
    end = time.monotonic() + seconds
    while not any(words in log.read_text() for log in folder.rglob("log.txt")):
        assert time.monotonic() < end, f"expected {words!r} in the log"
        time.sleep(0.05)  # another process writes it
