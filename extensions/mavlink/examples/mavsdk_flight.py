"""Arm, take off, fly two metres north by offboard, and land; it needs nothing of this project.

See `mavsdk.toml`.
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from mavsdk_grpc import System
from mavsdk_grpc.offboard import PositionNedYaw


async def main(address: str = "udpin://0.0.0.0:14540") -> None:
    """Fly, and print where it was."""
    drone: Any = System()
    await drone.connect(system_address=address)
    async for health in drone.telemetry.health():
        if health.is_global_position_ok and health.is_home_position_ok:
            break
    await drone.action.arm()
    await drone.action.takeoff()
    async for mode in drone.telemetry.flight_mode():
        if str(mode) == "HOLD":
            break
    await drone.offboard.set_position_ned(PositionNedYaw(2.0, 0.0, -2.5, 0.0))
    await drone.offboard.start()
    async for place in drone.telemetry.position_velocity_ned():
        if place.position.north_m > 1.8:
            print(f"{place.position.north_m:.1f} m north, {-place.position.down_m:.1f} m up")
            break
    await drone.action.land()
    async for armed in drone.telemetry.armed():
        if not armed:
            break
    print("landed")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
