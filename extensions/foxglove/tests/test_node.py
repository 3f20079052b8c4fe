"""The server as a node: on simulated time, and as a user would start it."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from events import Event
from extensions.foxglove.tests.client import Viewer
from runtime.errors import ConfigError, FatalError, MissingDependencyError
from runtime.testing import run_node
from tests.nodes.ros2.messages.samples import store
from tests.nodes.viewers.common.samples import CAMERA, ESTIMATOR, MS, VEHICLE, image, imu, odometry
from visnav_foxglove import FoxgloveServer
from visnav_foxglove.server import FoxgloveConfig, Server

ROOT = Path(__file__).parents[3]


def test_it_runs_where_nobody_looks(caplog: pytest.LogCaptureFixture) -> None:
    inputs: list[Event] = [VEHICLE, CAMERA, ESTIMATOR]
    inputs += [e for i in range(20) for e in (odometry(i * MS), imu(i * MS), image(i * MS))]
    with caplog.at_level("INFO"):
        result = run_node(FoxgloveServer, inputs=inputs, config={"port": 0}, duration=0.1)
    assert result.ticks["node.send_time"].calls == 5
    assert any("open ws://127.0.0.1:" in record.getMessage() for record in caplog.records)


def test_a_port_that_is_taken_ends_the_run_with_a_reason() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(FatalError, match=f"expected to listen on 127.0.0.1:{port}"):
            run_node(FoxgloveServer, config={"port": port})


@pytest.mark.parametrize(
    ("config", "message"),
    [({"port": 70_000}, "port"), ({"image_rate": -1}, "image_rate"), ({"size": 1}, "size")],
)
def test_settings_that_are_wrong_say_where(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run_node(FoxgloveServer, config=config)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(MissingDependencyError, match=r"pip install \./extensions/foxglove"):
        Server(FoxgloveConfig(), "test")


def test_who_connects_and_says_nothing_does_not_hold_up_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("visnav_foxglove.server._CLOSING", 0.1)
    server = Server(FoxgloveConfig(port=0), "test")
    port = int(server.address.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port)):
        ending = threading.Thread(target=server.close, daemon=True)
        ending.start()
        ending.join(30.0)
        assert not ending.is_alive()


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_viewer_comes_and_goes_while_the_example_flies(tmp_path: Path) -> None:
    """Images and poses come at their rates; a viewer that is cut off leaves the run alone."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "runtime", "run", "extensions/foxglove/examples/foxglove.toml"),
            *("--out", str(tmp_path), "--set", f"foxglove.port={port}"),
        ],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    )
    try:
        viewer = _connect(f"ws://127.0.0.1:{port}")
        topics = "/drone/camera/image_raw/compressed", "/tf_static", "/drone/odom"
        viewer.subscribe(*topics)
        end = time.monotonic() + 60.0
        while len(viewer.messages[topics[0]]) < 20 and time.monotonic() < end:
            viewer.take()
        assert len(viewer.messages[topics[0]]) >= 20
        assert len(viewer.messages[topics[2]]) > len(viewer.messages[topics[0]])
        static = store().deserialize(viewer.next("/tf_static"), "tf2_msgs/msg/TFMessage")
        assert len(static.transforms) == 3  # odom, the camera and its optical frame
        viewer.connection.socket.shutdown(socket.SHUT_RDWR)
        viewer.close()
        with _connect(f"ws://127.0.0.1:{port}") as another:
            another.subscribe(topics[0])
            another.next(topics[0])
        process.send_signal(signal.SIGINT)
        assert process.wait(30.0) in (0, 1)  # 1: so early the verdict may be anything
    finally:
        process.kill()
        process.wait()
    assert "Callback failed" not in (tmp_path / "log.txt").read_text()


def _connect(address: str) -> Viewer:
    end = time.monotonic() + 60.0
    while True:
        try:
            return Viewer(address)
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)  # for a process, which has a clock of its own
