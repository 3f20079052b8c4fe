"""The view as a node: on simulated time, and as a user would start and end it."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Event
from runtime.errors import ConfigError, MissingDependencyError, VisnavError
from runtime.testing import run_node
from tests.nodes.viewers.common.samples import (
    CAMERA,
    ESTIMATOR,
    MS,
    VEHICLE,
    Recorded,
    camera_pose,
    depth,
    features,
    image,
    odometry,
)
from visnav_rerun import RerunView, sdk
from visnav_rerun.node import Recorder
from visnav_rerun.sdk import RerunConfig

ROOT = Path(__file__).parents[3]


def flight(seconds: float) -> list[Event]:
    """Return what a flight says: 100 poses and 20 sets of images a second."""
    events: list[Event] = []
    for i in range(round(seconds * 100)):
        events.append(odometry(i * 10 * MS, (0.02 * i, 0.0, -1.0)))
        if i % 5 == 0:
            stamp = i * 10 * MS
            events += [camera_pose(stamp), depth(stamp), image(stamp), features(stamp)]
    return events


@pytest.mark.slow
def test_in_lockstep_all_is_recorded_and_as_many_images_as_asked_for(tmp_path: Path) -> None:
    inputs = [VEHICLE, CAMERA, ESTIMATOR, *flight(1.9)]
    run_node(RerunView, inputs=inputs, config={"image_rate": 4}, duration=1.9, out=tmp_path)
    recorded = Recorded(tmp_path / "flight.rrd")
    poses = recorded.stamps("map/drone", "Transform3D:translation")
    assert poses == [i * 10 * MS for i in range(190)]
    entity = "map/drone/camera"
    expected = [i * 250 * MS for i in range(8)]
    assert recorded.stamps(f"{entity}/rgb", "EncodedImage:blob") == expected
    assert recorded.stamps(f"{entity}/depth", "EncodedDepthImage:blob") == expected
    assert recorded.stamps(f"{entity}/rgb/features/vo", "Points2D:positions") == expected
    numbers = [n or 0 for _, n, _ in recorded.of("map/drone", "Transform3D:translation")]
    assert numbers == sorted(set(numbers))


def test_without_a_folder_there_is_nothing_to_view(caplog: pytest.LogCaptureFixture) -> None:
    run_node(RerunView, inputs=[VEHICLE, odometry(0)], duration=0.1)
    assert any("writes no files" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"mode": "show"}, "mode"),
        ({"file": "../flight.rrd"}, "file"),
        ({"jpeg_quality": 101}, "jpeg_quality"),
        ({"depth_stride": 0}, "depth_stride"),
        ({"port": 0}, "port"),
    ],
)
def test_settings_that_are_wrong_say_where(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run_node(RerunView, config=config)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependencyError, match=r"pip install \./extensions/rerun"):
        sdk.load()


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(VisnavError, match=f"^port: expected a free port 127.0.0.1:{port}"):
            sdk.Viewer(RerunConfig(mode="serve", port=port))
        with pytest.raises(VisnavError, match=f"^web_port: expected a free port 127.0.0.1:{port}"):
            sdk.Viewer(RerunConfig(mode="serve", port=free_port(), web_port=port))


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(MissingDependencyError, match="expects a display"):
        sdk.Viewer(RerunConfig(mode="spawn"))


@pytest.mark.slow
def test_the_page_is_served_on_the_loopback_only_and_ends_with_the_run() -> None:
    """The server listens at 127.0.0.1 and nowhere else, and is gone after `close`."""
    ports = free_port(), free_port()
    viewer = sdk.Viewer(RerunConfig(mode="serve", port=ports[0], web_port=ports[1]))
    try:
        assert viewer.page.startswith(f"http://127.0.0.1:{ports[1]}?url=rerun%2Bhttp")
        assert {address for port in ports for address in listening(port)} == {"0100007F"}
    finally:
        viewer.close()
    assert not any(listening(port) for port in ports)


@pytest.mark.slow
def test_a_viewer_that_goes_away_is_survived() -> None:
    """Its window is closed, or it crashes: logging goes on, and the end says that it has gone."""
    config = RerunConfig(mode="serve", port=free_port(), web_port=free_port())
    recorder = Recorder(config, "test", None)
    recorder.begin([VEHICLE])
    recorder.log([(0, odometry(0))])
    assert recorder._viewer is not None
    recorder._viewer._process.kill()
    recorder._viewer._process.wait()
    recorder.log([(i, odometry(i * MS)) for i in range(1, 100)])
    assert recorder.close() == "exit code -9"


@pytest.mark.slow
def test_a_viewer_that_stands_still_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it does not take is left out and counted; once it goes on, so does the view."""
    monkeypatch.setattr("visnav_rerun.node._TIMEOUT", 0.3)
    config = RerunConfig(mode="serve", port=free_port(), web_port=free_port(), jpeg_quality=0)
    noise = np.random.default_rng(0).integers(0, 255, (1000, 1000, 3), np.uint8)
    recorder = Recorder(config, "test", None)
    recorder.begin([VEHICLE, CAMERA])
    assert recorder._viewer is not None
    viewer = recorder._viewer._process
    large: Event = msgspec.structs.replace(image(0), data=noise)
    viewer.send_signal(signal.SIGSTOP)
    for i in range(20):
        recorder.log([(i, large)])
    left_out = recorder.left_out()
    assert left_out >= 10  # the rest lies in the buffers between the two
    viewer.send_signal(signal.SIGCONT)
    end = time.monotonic() + 30.0
    while not recorder._viewer_keeps_up() and time.monotonic() < end:
        pass  # it waits for the viewer, a process, which has a clock of its own
    recorder.log([(20, large)])
    assert recorder.left_out() == left_out
    viewer.send_signal(signal.SIGSTOP)
    for i in range(20):
        recorder.log([(i, large)])
    began = time.monotonic()
    assert recorder.close() == "it took nothing any more"
    assert time.monotonic() - began < 9.0  # a node has 10 s for its end


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_the_file_is_complete_after_ctrl_c(tmp_path: Path) -> None:
    """Ctrl-C in the middle of the example: all that was said until then can be read."""
    example = "extensions/rerun/examples/rerun.toml"
    process = subprocess.Popen(
        [*(sys.executable, "-m", "runtime", "run", example), "--out", str(tmp_path)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    )
    file = tmp_path / "flight.rrd"
    try:
        end = time.monotonic() + 60.0
        while not (file.exists() and file.stat().st_size > 300_000) and time.monotonic() < end:
            time.sleep(0.05)  # for a process, which has a clock of its own
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 0
    finally:
        process.kill()
        process.wait()
    sent = json.loads((tmp_path / "summary.json").read_text())["events"]
    recorded = Recorded(file)
    assert len(recorded.of("map/drone", "Transform3D:translation")) == sent["Odometry"]
    assert len(recorded.of("imu/angular_velocity/drone/imu", "Scalars:scalars")) == sent["Imu"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def listening(port: int) -> set[str]:
    """Return at which addresses a port is listened on, as the kernel writes them."""
    rows = []
    for table in ("tcp", "tcp6"):
        rows += Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    states = [(row.split()[1].split(":"), row.split()[3]) for row in rows]
    return {address for (address, p), state in states if int(p, 16) == port and state == "0A"}
