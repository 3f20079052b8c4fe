"""The client on our own server in another process, through a slow line."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[4]
SERVER = """
[run]
name = "server"
clock = "lockstep"
speed = 1.0
duration = "1h"

[[nodes]]
name = "drone"
type = "Multirotor"
world = "{world}"

[[nodes]]
name = "airsim"
type = "AirsimServer"
port = {port}
time = "paused"
"""
CLIENT = """
[run]
name = "client"
clock = "lockstep"
duration = "9s"

[[nodes]]
name = "drone"
type = "AirsimClient"
port = {port}
image_rate = 10
on_loss = "{on_loss}"

[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [[0.0, 0.0, -1.0], [1.0, 0.0, -1.0]]
"""


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


def program(folder: Path, text: str, name: str) -> list[str]:
    file = folder / f"{name}.toml"
    file.write_text(text)
    return [sys.executable, "-m", "runtime", "run", str(file), "--out", str(folder / name)]


@contextlib.contextmanager
def served(folder: Path, world: str) -> Iterator[int]:
    """Run a server, and yield its port."""
    port = free_port()
    command = program(folder, SERVER.format(port=port, world=world), "server")
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        try:
            yield port
        finally:
            process.terminate()


class Line:
    """A line to a server, whose replies are late by up to some time, at random.

    Args:
        to: Port of the server.
        late: Seconds.
        cut: Bytes of a connection after which it is cut, six times in all; 0 for never.
    """

    def __init__(self, to: int, late: float, cut: int = 0) -> None:
        self._to, self._late, self._cut = to, late, cut
        self._cuts = 6
        self._random = random.Random(1)

    @contextlib.contextmanager
    def open(self) -> Iterator[int]:
        """Listen, and yield the port."""
        with socket.create_server(("127.0.0.1", 0)) as listening:
            thread = threading.Thread(target=self._accept, args=(listening,), daemon=True)
            thread.start()
            yield listening.getsockname()[1]
            listening.shutdown(socket.SHUT_RDWR)
            thread.join()

    def _accept(self, listening: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                here, _ = listening.accept()
                threading.Thread(target=self._join, args=(here,), daemon=True).start()

    def _join(self, here: socket.socket) -> None:
        to = "127.0.0.1", self._to
        with here, contextlib.suppress(OSError), socket.create_connection(to) as there:
            ends = here, there, 0.0
            requests = threading.Thread(target=self._copy, args=ends, daemon=True)
            requests.start()
            self._copy(there, here, self._late)
            for end in (here, there):
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
            requests.join()

    def _copy(self, reader: socket.socket, writer: socket.socket, late: float) -> None:
        copied = 0
        with contextlib.suppress(OSError):
            while data := reader.recv(1 << 20):
                time.sleep(self._random.uniform(0.0, late))  # a slow line is what this is for
                writer.sendall(data)
                copied += len(data)
                if late and self._cuts and 0 < self._cut < copied:
                    self._cuts -= 1
                    break
        with contextlib.suppress(OSError):
            writer.shutdown(socket.SHUT_WR)


def fly(folder: Path, world: str, late: float, cut: int = 0) -> dict[str, Any]:
    """Fly a fresh server's vehicle, and return the summary of the run."""
    folder.mkdir()
    with served(folder, world) as port, Line(port, late, cut).open() as line:
        text = CLIENT.format(port=line, on_loss="reconnect" if cut else "stop")
        command = program(folder, text, "client")
        subprocess.run(command, cwd=ROOT, check=True, timeout=300)
    summary: dict[str, Any] = json.loads((folder / "client" / "summary.json").read_text())
    return summary


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_runs_are_equal_however_late_the_replies_are(tmp_path: Path, tiny_world: str) -> None:
    quick, slow = (fly(tmp_path / str(late), tiny_world, late) for late in (0.0, 0.01))
    assert quick["digest"] == slow["digest"] is not None
    assert quick["outputs"] == slow["outputs"]
    assert quick["outputs"]["drone.images"] == 90
    assert quick["outputs"]["drone.vehicle_events"] >= 2  # armed, and has taken off


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_flight_goes_on_after_a_lost_connection(tmp_path: Path, tiny_world: str) -> None:
    summary = fly(tmp_path / "cut", tiny_world, 0.001, cut=350_000)
    assert summary["outputs"]["drone.odometry"] >= 890
    assert summary["outputs"]["drone.vehicle_events"] >= 2
    log = (tmp_path / "cut" / "client" / "log.txt").read_text()
    assert "a connection is lost" in log
    assert "a set of images is lost" in log


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_example_flies_and_is_judged(tmp_path: Path) -> None:
    run, port = [sys.executable, "-m", "runtime", "run"], free_port()
    examples = "extensions/airsim/examples"
    server = [
        *run,
        f"{examples}/airsim.toml",
        "--set",
        "airsim.time=paused",
        "--out",
        f"{tmp_path}/s",
    ]
    command = [*run, f"{examples}/airsim_client.toml", "--out", f"{tmp_path}/c"]
    with subprocess.Popen([*server, "--set", f"airsim.port={port}"], cwd=ROOT) as process:
        try:
            change = ["--set", f"drone.port={port}"]
            subprocess.run([*command, *change], cwd=ROOT, check=True, timeout=300)
        finally:
            process.terminate()
    summary = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert summary["verdict"]["estimators"]["odometry"]["ate_percent"] < 1.0
    assert (tmp_path / "c" / "report.html").is_file()
