"""DroneKit flies a vehicle that is seen as ArduPilot's Copter: guided places, and a mission."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from extensions.mavlink.tests.flights import calling, flown, free_udp_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def wait_until(ok: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait for a flight beside this program: DroneKit has no other way."""
    end = time.monotonic() + seconds
    while not ok():
        assert time.monotonic() < end
        time.sleep(0.05)  # the vehicle flies in real time


def guided(address: str) -> None:
    """Arm, take off, go somewhere, fly a mission up to its last item, return."""
    from dronekit import Command, LocationGlobalRelative, VehicleMode, connect

    vehicle: Any = connect(address, wait_ready=True, heartbeat_timeout=60)
    assert vehicle.parameters["MPC_XY_CRUISE"] == 2.0
    wait_until(lambda: vehicle.is_armable)
    vehicle.mode = VehicleMode("GUIDED")
    vehicle.armed = True
    wait_until(lambda: vehicle.armed)
    vehicle.simple_takeoff(3.0)
    wait_until(lambda: vehicle.location.global_relative_frame.alt > 2.8)
    home = vehicle.location.global_frame
    north = LocationGlobalRelative(home.lat + 4.0 / 111_200, home.lon, 3.0)
    vehicle.simple_goto(north, groundspeed=3)
    wait_until(lambda: vehicle.location.local_frame.north > 3.7)
    commands = vehicle.commands
    commands.download()
    commands.wait_ready()
    commands.clear()
    for metres in (4.0, 2.0):
        place = home.lat + metres / 111_200, home.lon, 3.0
        commands.add(Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, *place))
    commands.upload()
    commands.download()
    commands.wait_ready()
    assert len(commands) == 2
    assert abs(commands[1].x - home.lat - 2.0 / 111_200) < 4e-6  # 32-bit degrees
    commands.next = 1
    vehicle.mode = VehicleMode("AUTO")
    wait_until(lambda: vehicle.mode.name == "AUTO")
    wait_until(lambda: vehicle.location.local_frame.north < 2.3)
    vehicle.mode = VehicleMode("RTL")
    wait_until(lambda: not vehicle.armed)
    vehicle.close()


def test_dronekit_flies_to_places_and_a_mission(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_dronekit", "guided", f"udpin:127.0.0.1:{port}", plain=True)
    settings = ('mavlink.autopilot="ardupilot"',)
    _, ended = flown(tmp_path, port, *script, settings=settings)
    # Armed, landed and disarmed; taken off only if the take-off was over before it was left.
    assert ended["outputs"]["drone.vehicle_events"] in {3, 4}
