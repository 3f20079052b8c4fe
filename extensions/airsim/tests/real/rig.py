"""A run with a server in a process of its own, and scripts in the process of a real client."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from extensions.airsim.tests.real.environments import CLIENTS, python_of
from tests.runtime.tools.samples_cli import ROOT, start, summary

SCRIPTS = Path(__file__).with_name("client_side.py")
LISTENING = re.compile(r"may connect to\s+\S+:(\d+)")

WORLD = """
<mujoco>
  <worldbody>
    <light pos="0 0 8" dir="0 0 -1"/>
    <geom name="floor" type="plane" size="40 40 0.1" rgba="0.5 0.5 0.4 1"/>
    <geom name="crate" type="box" size="0.4 0.4 0.4" pos="4 0 0.4" rgba="0.8 0.3 0.1 1"/>
    <geom name="ball" type="sphere" size="0.5" pos="6 -2 0.5" rgba="0.1 0.4 0.8 1"/>
    <geom name="wall" type="box" size="0.1 6 2" pos="9 0 2" rgba="0.3 0.7 0.3 1"/>
  </worldbody>
</mujoco>
"""

HEAD = """
[run]
name = "real_client"
clock = "lockstep"
speed = {speed}
duration = "300s"

[[nodes]]
name = "drone"
type = "Multirotor"
world = "{world}"
camera_processes = 1
{drone}
"""

SERVER = """
[[nodes]]
name = "airsim"
type = "AirsimServer"
port = 0
{settings}
"""

CAMERA = """
[[nodes.cameras]]
name = "front_center"
images = ["rgb", "depth", "segmentation"]
width = 64
height = 48
rate = 10
latency = 0
position = [0.46, 0.0, 0.0]
"""

SENSORS = """
[nodes.barometer]
drift = 0.0

[nodes.magnetometer]

[nodes.gnss]

[[nodes.range_finders]]
name = "distance"

[[nodes.lidars]]
name = "lidar"
channels = 16
columns = 128
"""


class Rig:
    """A run that goes on, which scripts of a client may fly.

    Attributes:
        folder: Where the run's results are, once it has ended.
        said: What the run has logged.
    """

    def __init__(self, folder: Path, process: subprocess.Popen[str]) -> None:
        self.folder = folder
        self.said = ""
        self._process = process
        self._listening = threading.Event()
        self._port = 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.said += line
            if not self._port and (match := LISTENING.search(self.said)):
                self._port = int(match[1])
                self._listening.set()
        self._listening.set()

    @property
    def port(self) -> int:
        """The port at which the server listens, once it does."""
        assert self._listening.wait(120), self.said
        assert self._port, self.said
        return self._port

    def script(self, client: str, name: str, *arguments: str, limit: float = 120) -> Any:
        """Run a function of `client_side` with a client, and return what it returns."""
        module = CLIENTS[client].module
        command = [str(python_of(client)), str(SCRIPTS), module, str(self.port), name, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
        assert done.returncode == 0, f"{done.stdout}{done.stderr}\nthe run:\n{self.said}"
        *printed, result = done.stdout.splitlines()
        report = json.loads(result)
        assert not [line for line in printed if "WARN" in line.upper()], printed
        return report

    def end(self, *, interrupt: bool = True) -> Any:
        """End the run as Ctrl-C does, or wait for its own end, and return its summary."""
        if interrupt:
            self._process.send_signal(signal.SIGINT)
        code = self._process.wait(60)
        self._reader.join(10)
        assert code == 0, self.said
        assert "Traceback" not in self.said, self.said
        return summary(self.folder)


@contextmanager
def flown(
    folder: Path,
    *,
    settings: str = "",
    drone: str = CAMERA,
    nodes: str = "",
    speed: str = "1.0",
    text: str = "",
) -> Iterator[Rig]:
    """Start a run in a small world, with a server that a real client may connect to.

    Args:
        folder: For files, and for the run's results.
        settings: Of the server.
        drone: Settings and cameras of the drone.
        nodes: Tables of further nodes.
        speed: Of the run.
        text: The whole file, in place of all these.
    """
    world = folder / "small.xml"
    world.write_text(WORLD)
    file = folder / "run.toml"
    head = HEAD.format(world=world, drone=drone, speed=speed)
    file.write_text(text or head + nodes + SERVER.format(settings=settings))
    out = folder / "out"
    with start(["run", file, "--quiet", "--log", "info", "--out", out], ROOT) as process:
        try:
            yield Rig(out, process)
        finally:
            if process.poll() is None:
                process.kill()
