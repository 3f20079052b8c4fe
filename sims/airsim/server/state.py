"""Methods that tell where a vehicle is, and how it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sims.airsim.server.methods import rpc
from sims.airsim.structures import KinematicsState, MultirotorState, Pose

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer


class VehicleState:
    """The true state of vehicles."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("getMultirotorState")
    def multirotor_state(self, vehicle_name: str) -> MultirotorState:
        """Return the true state, with its exact stamp, and the last collision."""
        vehicle = self._server.find_multirotor(vehicle_name)
        kinematics = vehicle.kinematics()
        return MultirotorState(
            vehicle.collision,
            kinematics,
            vehicle.geo_point(vehicle.in_map(kinematics.position)),
            vehicle.stamp,
            0 if vehicle.landed() else 1,
        )

    @rpc("simGetVehiclePose")
    def vehicle_pose(self, vehicle_name: str) -> Pose:
        """Return a vehicle's true pose in its local frame."""
        return self._server.find_vehicle(vehicle_name).pose()

    @rpc("simGetGroundTruthKinematics")
    def kinematics(self, vehicle_name: str) -> KinematicsState:
        """Return how a vehicle truly moves; the accelerations are those of the physics."""
        return self._server.find_vehicle(vehicle_name).kinematics()
