"""Methods that take control of a vehicle, and that put it somewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from events import Arm, Disarm
from sims.airsim.server.methods import rpc
from sims.airsim.server.vehicles import ServedMultirotor

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer


class Control:
    """Control of vehicles."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("enableApiControl")
    def enable_api_control(self, is_enabled: bool, vehicle_name: str) -> None:
        """Let clients command a vehicle, or not; a vehicle that counts as armed is armed then."""
        vehicle = self._server.find_vehicle(vehicle_name)
        vehicle.api_control = is_enabled
        if is_enabled and vehicle.armed:
            self._arm(vehicle)

    @rpc("isApiControlEnabled")
    def is_api_control_enabled(self, vehicle_name: str) -> bool:
        """Return whether clients may command a vehicle."""
        return self._server.find_vehicle(vehicle_name).api_control

    @rpc("armDisarm")
    def arm_disarm(self, arm: bool, vehicle_name: str) -> bool:
        """Arm, or stop the motors, in the air too; ``False`` without API control."""
        vehicle = self._server.find_multirotor(vehicle_name)
        if not vehicle.api_control:
            return False
        vehicle.armed = arm
        if arm:
            self._arm(vehicle)
        elif vehicle.motors_on:
            vehicle.motors_on = False
            self._server.order(Disarm, vehicle)
        return True

    def _arm(self, vehicle: object) -> None:
        if isinstance(vehicle, ServedMultirotor) and not vehicle.motors_on:
            vehicle.motors_on = True
            self._server.order(Arm, vehicle)
