"""Services of whole runs, called by a ROS 2 client that nobody here wrote, in its own process."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.nodes.ros2.bridge.network import free_port

pytest.importorskip("zenoh_ros2_sdk")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

SIMULATION = "simulation_interfaces/srv"
RESULT = "\n---\nsimulation_interfaces/Result result"
DEFINITIONS = {
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    f"{SIMULATION}/GetSimulatorFeatures": "---\nsimulation_interfaces/SimulatorFeatures features",
    f"{SIMULATION}/GetSimulationState": (
        "---\nsimulation_interfaces/SimulationState state\nsimulation_interfaces/Result result"
    ),
    f"{SIMULATION}/SetSimulationState": f"simulation_interfaces/SimulationState state{RESULT}",
    f"{SIMULATION}/StepSimulation": f"uint64 steps{RESULT}",
    f"{SIMULATION}/ResetSimulation": f"uint8 scope{RESULT}",
}
FILE = """
[run]
name = "served"
duration = "{duration}s"
stall = 0
startup_limit = "5min"

[[nodes]]
name = "drone"
type = "Multirotor"
world = "hall"

[[nodes]]
name = "ros2"
type = "Ros2Bridge"
connect = []
listen = ["tcp/127.0.0.1:{port}"]
{more}
"""
PILOT = """
[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [[0.0, 0.0, -1.5], [1.0, 0.2, -1.5]]
"""
PAUSED = 'paused = true\nservices = ["simulation", "vehicle"]'


class Client:
    """Asks, and waits for the answer."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._asked = 0

    def call(self, name: str, type_: str, **fields: Any) -> Any:
        self._asked += 1
        asked = {"id": self._asked, "name": name, "type": type_, "fields": fields, "seconds": 300}
        asked["definition"] = DEFINITIONS[type_]
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        assert answer["id"] == self._asked
        return answer["response"]

    def trigger(self, name: str) -> Any:
        return self.call(f"/drone/{name}", "std_srvs/srv/Trigger")

    def step(self, steps: int) -> None:
        reply = self.call("/step_simulation", f"{SIMULATION}/StepSimulation", steps=steps)
        assert reply["result"] == {"result": 1, "error_message": ""}

    def set_state(self, state: int) -> None:
        wanted = {"type": "simulation_interfaces/msg/SimulationState", "state": state}
        type_ = f"{SIMULATION}/SetSimulationState"
        reply = self.call("/set_simulation_state", type_, state=wanted)
        assert reply["result"] == {"result": 1, "error_message": ""}


def command(folder: Path, port: int, more: str, duration: float) -> list[str]:
    file = folder.with_suffix(".toml")
    file.write_text(FILE.format(duration=duration, port=port, more=more))
    return [sys.executable, "-m", "runtime", "run", str(file), "-q", "--out", str(folder)]


@contextlib.contextmanager
def client(folder: Path, more: str, duration: float) -> Iterator[Client]:
    """Start a run and a client of it; both have ended afterwards."""
    port = free_port()
    asks = [sys.executable, "-m", f"{__package__}.sdk_services", str(port)]
    pipes: dict[str, Any] = {"text": True, "stdout": subprocess.PIPE}
    with (
        subprocess.Popen(command(folder, port, more, duration), **pipes) as run,
        subprocess.Popen(asks, stdin=subprocess.PIPE, **pipes) as process,
    ):
        try:
            yield Client(process)
            assert run.wait(200) == 0
        finally:
            run.kill()
            process.kill()


def summary(folder: Path) -> Any:
    return json.loads((folder / "summary.json").read_text())


def steer(folder: Path) -> Any:
    """Fly by services alone, of a run that begins paused; return its summary."""
    with client(folder, PAUSED, 30.0) as there:
        features = there.call("/get_simulator_features", f"{SIMULATION}/GetSimulatorFeatures")
        assert features["features"]["features"] == {"size": 6, "first": [24, 25, 26, 31]}
        state = there.call("/get_simulation_state", f"{SIMULATION}/GetSimulationState")
        assert state["state"]["state"] == 2
        reset = there.call("/reset_simulation", f"{SIMULATION}/ResetSimulation", scope=0)
        assert reset["result"]["result"] == 0
        sent = "is sent; time stands"
        assert there.trigger("arm") == {"success": True, "message": f"Arm {sent}"}
        there.step(100)
        assert there.trigger("arm") == {"success": True, "message": "drone is armed already"}
        assert there.trigger("take_off") == {"success": True, "message": f"Takeoff {sent}"}
        there.step(5000)
        assert there.trigger("land") == {"success": True, "message": f"Land {sent}"}
        there.step(6000)
        assert there.trigger("disarm") == {"success": True, "message": "drone is disarmed already"}
        there.set_state(0)
    return summary(folder)


def test_a_flight_by_services_alone_is_the_same_each_time_if_time_stands(tmp_path: Path) -> None:
    first, second = steer(tmp_path / "one"), steer(tmp_path / "two")
    assert first["digest"] == second["digest"]
    assert first["sim_seconds"] == second["sim_seconds"] == 11.1
    assert first["reason"] == "ended by ROS"
    assert first["events"]["TakenOff"] == first["events"]["Landed"] == 1


def test_replies_say_what_vehicles_have_done(tmp_path: Path) -> None:
    with client(tmp_path / "run", PAUSED, 3600.0) as there:
        there.set_state(1)
        for name, done in (("arm", "Armed"), ("take_off", "TakenOff"), ("land", "Landed")):
            assert there.trigger(name) == {"success": True, "message": done}
        there.set_state(3)


def test_a_run_stepped_from_outside_has_the_digest_of_one_never_paused(tmp_path: Path) -> None:
    quiet = tmp_path / "quiet"
    subprocess.run(command(quiet, free_port(), PILOT, 6.0), check=True, timeout=300)
    stepped, busy = tmp_path / "stepped", list[subprocess.Popen[bytes]]()
    try:
        with client(stepped, PAUSED + PILOT, 6.0) as there:
            there.step(2)  # so it has started, which takes long enough as it is
            burn = [sys.executable, "-c", "while True: pass"]
            busy += [subprocess.Popen(burn), subprocess.Popen(burn)]
            for steps in (1, 7, 100, 1, 333, 1000):
                there.step(steps)
            there.set_state(1)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert summary(stepped)["digest"] == summary(quiet)["digest"]
    assert summary(stepped)["sim_seconds"] == summary(quiet)["sim_seconds"] == 6.0


def test_a_run_stepped_by_the_action_has_the_digest_of_one_never_paused(tmp_path: Path) -> None:
    quiet, stepped, port = tmp_path / "quiet", tmp_path / "stepped", free_port()
    subprocess.run(command(quiet, free_port(), PILOT, 20.0), check=True, timeout=300)
    steps = [str(count) for count in (1, 7, 1333, 100_000)]
    acts = [sys.executable, "-m", f"{__package__}.sdk_action", str(port), *steps]
    with subprocess.Popen(command(stepped, port, PAUSED + PILOT, 20.0)) as run:
        try:
            acted = subprocess.run(acts, check=True, stdout=subprocess.PIPE, timeout=400)
            assert run.wait(200) == 0
        finally:
            run.kill()
    heard = json.loads(acted.stdout.splitlines()[-1])
    assert heard["results"] == [[4, 1], [4, 1], [4, 1], [5, 4]]
    for progress in ([1, 0], [7, 0], [1333, 0]):
        assert progress in heard["feedback"]
    assert sum(heard["feedback"][-1]) == 100_000
    assert heard["statuses"][0] == [2]
    assert heard["statuses"][-3:] == [[4, 4, 4, status] for status in (2, 3, 5)]
    assert summary(stepped)["digest"] == summary(quiet)["digest"]
    assert summary(stepped)["sim_seconds"] == summary(quiet)["sim_seconds"] < 20.0
