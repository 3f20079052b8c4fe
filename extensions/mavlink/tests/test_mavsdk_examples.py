"""What MAVSDK's own examples call is flown: where they fly, from where they take off.

Their repository has these examples, its package on PyPI does not: the scripts here make the same
calls, with shorter ways. What each example does as it is stands on the page of this extension.
"""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest

from extensions.mavlink.tests.flights import calling, first, flown, free_udp_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

PLACES = (  # of mission.py
    (47.398039859999997, 8.5455725400000002), (47.398036222362471, 8.5450146439425509),
    (47.397825620791885, 8.5450092830163271),
)  # fmt: skip


async def connected(address: str) -> Any:
    """Return a system that is there and knows where it is, as the examples wait for it."""
    from mavsdk_grpc import System

    drone: Any = System(port=free_udp_port())
    await drone.connect(system_address=address)
    await first(drone.core.connection_state(), lambda state: state.is_connected)
    await first(
        drone.telemetry.health(), lambda h: h.is_global_position_ok and h.is_home_position_ok
    )
    return drone


async def goto(address: str) -> None:
    """Fly as goto.py, takeoff_and_land.py and the examples of telemetry do, 190 m to the west."""
    drone = await connected(address)
    sky = drone.telemetry
    home = await first(sky.home())
    assert home.absolute_altitude_m == pytest.approx(488.0, abs=0.2)
    assert home.latitude_deg == pytest.approx(47.397742, abs=1e-6)
    for stream in (sky.battery(), sky.gps_info(), sky.attitude_euler(), sky.odometry()):
        assert await first(stream)
    assert (await drone.info.get_version()).flight_sw_major >= 1
    assert not await first(sky.in_air())
    await drone.param.set_param_float("MPC_XY_CRUISE", 12.0)
    await drone.action.arm()
    await drone.action.takeoff()
    await first(sky.flight_mode(), lambda mode: str(mode) == "TAKEOFF")
    await first(sky.in_air(), lambda is_in_air: is_in_air)
    await drone.action.goto_location(47.397606, 8.543060, home.absolute_altitude_m + 20.0, 0)
    await first(sky.position(), lambda place: abs(place.longitude_deg - 8.543060) < 1e-5)
    place = await first(sky.position(), lambda place: abs(place.relative_altitude_m - 20.0) < 0.5)
    print(f"{place.latitude_deg:.5f} {place.longitude_deg:.5f}")


def test_the_example_goto_flies_190_m(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_mavsdk_examples", "goto", f"udpin://127.0.0.1:{port}")
    printed, _ = flown(tmp_path, port, *script)
    assert printed == "47.39761 8.54306\n"


async def mission(address: str) -> None:
    """Fly as mission.py and mission_raw.py do, and see each item counted and the return landed."""
    from mavsdk_grpc.mission import MissionItem, MissionPlan
    from mavsdk_grpc.mission_raw import MissionItem as RawItem

    drone = await connected(address)
    nan = math.nan
    raw = [
        RawItem(k, 3, 16, int(k == 0), 1, 0, 10, 0, nan, 474027175, east, 30.0, 0)
        for k, east in enumerate((85428502, 85436189))
    ]
    await drone.mission_raw.upload_mission(raw)
    back = await drone.mission_raw.download_mission()
    assert [(item.x, item.y, item.z) for item in back] == [(i.x, i.y, i.z) for i in raw]
    await drone.mission_raw.clear_mission()
    none, nothing = MissionItem.CameraAction.NONE, MissionItem.VehicleAction.NONE
    items = [
        MissionItem(*place, 10, 10, True, nan, nan, none, nan, nan, nan, nan, nan, nothing)
        for place in PLACES
    ]
    counted: dict[tuple[int, int], None] = {}  # in the order in which they came

    async def count() -> None:
        async for progress in drone.mission.mission_progress():
            counted[progress.current, progress.total] = None

    counting = asyncio.create_task(count())
    await drone.mission.set_return_to_launch_after_mission(True)
    await drone.mission.upload_mission(MissionPlan(items))
    await drone.action.arm()
    await drone.mission.start_mission()
    await first(drone.telemetry.in_air(), lambda is_in_air: is_in_air)
    await first(drone.telemetry.in_air(), lambda is_in_air: not is_in_air)
    counting.cancel()
    assert list(counted) == [(k, 3) for k in range(4)]
    assert await drone.mission.is_mission_finished()
    place = (await first(drone.telemetry.position_velocity_ned())).position
    assert math.hypot(place.north_m, place.east_m) < 0.5
    await first(drone.telemetry.armed(), lambda armed: not armed)


def test_the_example_mission_is_counted_and_returns(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_mavsdk_examples", "mission", f"udpin://127.0.0.1:{port}")
    _, ended = flown(tmp_path, port, *script)
    assert ended["outputs"]["drone.vehicle_events"] == 3  # armed, landed, disarmed


async def landing(address: str) -> None:
    """Fly a mission that ends with a landing, which is reached when it has landed."""
    from mavsdk_grpc.mission_raw import MissionItem as RawItem

    drone = await connected(address)
    north, east = round(47.397742e7) + 400, round(8.545594e7)  # 4.4 m
    kinds = ((22, 0.0, 3.0), (16, 0.0, 3.0), (21, 0.0, 0.0))
    items = [
        RawItem(k, 6, kind, int(k == 0), 1, 0, 0, 0, math.nan, north, east, z, 0)
        for k, (kind, _, z) in enumerate(kinds)
    ]
    await drone.mission_raw.upload_mission(items)
    await drone.action.arm()
    await drone.mission_raw.start_mission()
    await first(drone.mission_raw.mission_progress(), lambda p: p.current == p.total == 3)
    assert not await first(drone.telemetry.in_air())
    place = (await first(drone.telemetry.position_velocity_ned())).position
    assert place.north_m == pytest.approx(4.4, abs=0.5)


def test_a_landing_is_the_end_of_a_mission_once_it_has_landed(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_mavsdk_examples", "landing", f"udpin://127.0.0.1:{port}")
    _, ended = flown(tmp_path, port, *script)
    assert ended["outputs"]["drone.vehicle_events"] == 3


async def offboard(address: str) -> None:
    """Steer by each kind of set-point that the examples of offboard have, then land."""
    from mavsdk_grpc.offboard import Attitude, PositionNedYaw, VelocityBodyYawspeed, VelocityNedYaw

    drone = await connected(address)
    wheel, sky = drone.offboard, drone.telemetry

    async def until(ok: Any) -> None:
        await first(sky.position_velocity_ned(), lambda sample: ok(sample.position))

    await drone.action.arm()
    await wheel.set_position_ned(PositionNedYaw(0.0, 0.0, 0.0, 0.0))
    await wheel.start()
    await wheel.set_position_ned(PositionNedYaw(0.0, 0.0, -3.0, 90.0))
    await until(lambda place: abs(place.down_m + 3.0) < 0.2)
    await first(sky.attitude_euler(), lambda angles: abs(angles.yaw_deg - 90.0) < 5.0)
    await wheel.set_velocity_ned(VelocityNedYaw(1.5, 0.0, 0.0, 90.0))
    await until(lambda place: place.north_m > 2.0)
    await wheel.set_velocity_body(VelocityBodyYawspeed(1.5, 0.0, 0.0, 0.0))  # it looks east
    await until(lambda place: place.east_m > 1.5)
    await wheel.set_position_velocity_ned(
        PositionNedYaw(4.0, 0.0, -3.0, 0.0), VelocityNedYaw(0.5, 0.0, 0.0, 0.0)
    )
    await until(lambda place: abs(place.north_m - 4.0) < 0.5 and abs(place.east_m) < 0.5)
    await wheel.set_attitude(Attitude(12.0, 0.0, 0.0, 0.6))
    await first(sky.attitude_euler(), lambda angles: angles.roll_deg > 9.0)
    await wheel.set_position_ned(PositionNedYaw(4.0, 0.0, -2.0, 0.0))
    await until(lambda place: abs(place.down_m + 2.0) < 0.3 and abs(place.east_m) < 0.5)
    await wheel.stop()
    await first(sky.flight_mode(), lambda mode: str(mode) == "HOLD")
    await drone.action.land()
    await first(sky.armed(), lambda armed: not armed)


def test_the_examples_of_offboard_steer(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_mavsdk_examples", "offboard", f"udpin://127.0.0.1:{port}")
    _, ended = flown(tmp_path, port, *script)
    assert ended["outputs"]["drone.vehicle_events"] == 3
