"""MAVSDK's own client flies the example, and an estimator outside is judged as one inside."""

from __future__ import annotations

import asyncio
import socket
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

import visnav
from events import PoseEstimate
from extensions.mavlink.tests.flights import calling, first, flown, free_udp_port
from runtime import Node, NodeConfig, on

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def test_the_script_of_the_example_flies(tmp_path: Path) -> None:
    port = free_udp_port()
    script = "extensions/mavlink/examples/mavsdk_flight.py", f"udpin://127.0.0.1:{port}"
    printed, ended = flown(tmp_path, port, *script)
    assert printed.splitlines()[-1] == "landed"
    assert ended["outputs"]["drone.vehicle_events"] == 4  # armed, taken off, landed, disarmed
    assert "mavlink" in ended["not_deterministic"]


def test_an_estimator_outside_is_judged(tmp_path: Path) -> None:
    """By pymavlink's own connection: its poses are one percent too long, and hardly late."""
    port = free_udp_port()
    script = "extensions/mavlink/examples/external_vision.py", f"udpin:127.0.0.1:{port}", "10"
    printed, ended = flown(tmp_path, port, *script, example="external_vision")
    figures = ended["verdict"]["estimators"]["vision"]
    assert printed == f"{figures['estimates']} poses\n"
    assert figures["passed"]
    assert figures["scale"] == pytest.approx(1 / 1.01, rel=1e-3)
    assert figures["velocities_percent"] == 100.0
    assert figures["velocity_error_percent"] < 10.0
    words = ended["environment"]["vision: poses from outside"]
    count = figures["estimates"]
    assert words == f"{count} poses taken ({count} with a velocity)"


async def everything(address: str) -> None:
    """Fly by MAVSDK's plugins: parameters, refusals, offboard, go to a place, a mission, return."""
    from mavsdk_grpc import System
    from mavsdk_grpc.action import ActionError
    from mavsdk_grpc.mission import MissionItem, MissionPlan
    from mavsdk_grpc.offboard import OffboardError, VelocityBodyYawspeed

    drone: Any = System(port=free_udp_port())
    await drone.connect(system_address=address)
    await first(drone.telemetry.health(), lambda health: health.is_armable)
    await drone.action.set_takeoff_altitude(1.5)
    assert await drone.action.get_takeoff_altitude() == 1.5
    assert len((await drone.param.get_all_params()).float_params) == 3
    with pytest.raises(ActionError, match="DENIED"):
        await drone.action.takeoff()  # before it is armed
    await drone.action.arm()
    await drone.action.takeoff()
    await first(drone.telemetry.flight_mode(), lambda mode: str(mode) == "HOLD")
    with pytest.raises(OffboardError):
        await drone.offboard.start()
    await drone.offboard.set_velocity_body(VelocityBodyYawspeed(0.5, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    place = drone.telemetry.position_velocity_ned()
    await first(place, lambda sample: sample.position.north_m > 0.5)
    await drone.offboard.stop()
    home = await first(drone.telemetry.home())
    altitude, nan = home.absolute_altitude_m, float("nan")
    north = home.latitude_deg + 1.0 / 111_300
    await drone.action.goto_location(north, home.longitude_deg, altitude + 2.0, 0.0)
    await first(
        drone.telemetry.position(), lambda position: abs(position.relative_altitude_m - 2) < 0.1
    )
    none, nothing = MissionItem.CameraAction.NONE, MissionItem.VehicleAction.NONE
    items = [
        MissionItem(
            home.latitude_deg + metres / 111_300, home.longitude_deg, 1.8, 1.5, True,
            nan, nan, none, nan, nan, nan, nan, nan, nothing,
        )
        for metres in (0.5, 1.5)
    ]  # fmt: skip
    await drone.mission.set_return_to_launch_after_mission(True)
    await drone.mission.upload_mission(MissionPlan(items))
    assert len((await drone.mission.download_mission()).mission_items) == 2
    await drone.mission.start_mission()
    await first(
        drone.mission.mission_progress(), lambda progress: progress.current == progress.total == 2
    )
    await first(drone.telemetry.armed(), lambda armed: not armed)


def test_all_plugins_fly(tmp_path: Path) -> None:
    port = free_udp_port()
    _, ended = flown(
        tmp_path, port, *calling("test_mavsdk", "everything", f"udpin://127.0.0.1:{port}")
    )
    assert ended["outputs"]["drone.vehicle_events"] == 4


class CompanionConfig(NodeConfig):
    """Settings: where its link ends."""

    link: str


class Companion(Node[CompanionConfig]):
    """Sends an estimator's poses by MAVLink, as a program outside would."""

    async def on_startup(self) -> None:
        from pymavlink.dialects.v20 import common as mav

        self._mav = mav.MAVLink(None, 1, 197)
        link = urlsplit(self.config.link)
        self._socket = socket.create_connection((link.hostname, link.port))

    @on(PoseEstimate)
    def poses(self, event: PoseEstimate) -> None:
        """Send one on."""
        if event.source != "inside":
            return
        zeros, unknown = (0.0,) * 6, [float("nan")] + [0.0] * 20
        message = self._mav.odometry_encode(
            event.stamp // 1000, 1, 12, *event.position, [*event.orientation], *zeros,
            unknown, unknown,
        )  # fmt: skip
        self._socket.sendall(message.pack(self._mav))

    async def on_shutdown(self) -> None:
        self._socket.close()


def test_poses_by_mavlink_are_judged_as_those_inside(tmp_path: Path, monkeypatch: Any) -> None:
    """Within what their stamps and numbers resolve: microseconds, and 32-bit floats."""
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    pilot = {"start_delay": "0s", "waypoints": [[0.0, 0.0, -1.0], [2.0, 0.0, -1.0]]}
    table = {
        "run": {"name": "vision", "duration": "40s", "speed": 1.0},
        "nodes": [
            {"name": "drone", "type": "Multirotor", "world": "hall"},
            {"name": "pilot", "type": "WaypointFollower"} | pilot,
            {"name": "vision", "type": "Mavlink", "endpoints": [link], "vision": True},
            {"name": "inside", "type": "SyntheticOdometry", "drift": 2.0, "noise": 0.01},
            {"name": "companion", "type": Companion, "link": link},
            {"name": "evaluation", "type": "Evaluation"},
        ],
    }
    figures = visnav.run(table, quiet=True).figures
    inside, outside = figures["inside"], figures["vision"]
    assert outside["estimates"] == pytest.approx(inside["estimates"], abs=2)
    assert outside["ate_rmse_m"] == pytest.approx(inside["ate_rmse_m"], rel=0.02)
    assert inside["ate_rmse_m"] > 0.01


def test_two_vehicles_are_two_systems(tmp_path: Path, monkeypatch: Any) -> None:
    """Each on its own endpoint, and each where it stands."""
    from pymavlink.dialects.v20 import common as mav

    monkeypatch.chdir(tmp_path)
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    nodes: list[dict[str, Any]] = [{"name": "world", "type": "World", "world": "hall"}]
    for number, end in enumerate(ends, 1):
        end.bind(("127.0.0.1", 0))
        end.setblocking(False)
        link, name = f"udp://127.0.0.1:{end.getsockname()[1]}", f"drone_{number}"
        nodes += [
            {"name": name, "type": "Multirotor", "position": [number - 1.0, 0.0]},
            {
                "name": f"mavlink_{number}", "type": "Mavlink", "vehicle": name,
                "system_id": number, "endpoints": [link],
            },
        ]  # fmt: skip
    run = {"name": "two", "duration": "1s", "speed": 1.0}
    visnav.run({"run": run, "nodes": nodes}, quiet=True)
    for number, end in enumerate(ends, 1):
        parser = mav.MAVLink(None)
        heard: list[Any] = []
        with end:
            while True:
                try:
                    heard += parser.parse_buffer(end.recv(65535)) or []
                except BlockingIOError:
                    break
        assert {message.get_srcSystem() for message in heard} == {number}
        places = [message.x for message in heard if message.get_type() == "LOCAL_POSITION_NED"]
        assert places[-1] == pytest.approx(number - 1.0, abs=0.01)


if __name__ == "__main__":
    asyncio.run(everything(sys.argv[1]))
