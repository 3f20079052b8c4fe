"""Methods that tell where a vehicle is, and how it moves."""

from __future__ import annotations

from math import pi, sqrt
from typing import TYPE_CHECKING

from sims.airsim.server.methods import rpc
from sims.airsim.structures import (
    ComputerVisionState,
    EnvironmentState,
    GeoPoint,
    KinematicsState,
    MultirotorState,
    Pose,
    RotorParameters,
    RotorStates,
    Vector3r,
)
from sims.sensors.earth import pressure_at, temperature_at

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

GAS_CONSTANT = 287.053
"""Of dry air, J/(kg K)."""


class VehicleState:
    """The true state of vehicles."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("getMultirotorState")
    def multirotor_state(self, vehicle: str) -> MultirotorState:
        """Return the true state, with its exact stamp, and the last collision."""
        served = self._server.find_multirotor(vehicle)
        kinematics = served.kinematics()
        return MultirotorState(
            served.collision,
            kinematics,
            served.geo_point(served.in_map(kinematics.position)),
            served.stamp,
            0 if served.landed() else 1,
        )

    @rpc("getComputerVisionState")
    def computer_vision_state(self, vehicle: str) -> ComputerVisionState:
        """Return a vehicle's true state, of either kind, with its exact stamp."""
        served = self._server.find_vehicle(vehicle)
        return ComputerVisionState(served.kinematics(), served.stamp)

    @rpc("simGetVehiclePose")
    def vehicle_pose(self, vehicle: str) -> Pose:
        """Return a vehicle's true pose in its local frame."""
        return self._server.find_vehicle(vehicle).pose()

    @rpc("simGetGroundTruthKinematics")
    def kinematics(self, vehicle: str) -> KinematicsState:
        """Return how a vehicle truly moves; the accelerations are those of the physics."""
        return self._server.find_vehicle(vehicle).kinematics()

    @rpc("simGetGroundTruthEnvironment")
    def environment(self, vehicle: str) -> EnvironmentState:
        """Return the standard atmosphere, and the world's gravity, where a vehicle is."""
        served = self._server.find_vehicle(vehicle)
        position = served.state().position
        place = served.geo_point(position)
        pressure, temperature = pressure_at(place.altitude), temperature_at(place.altitude)
        return EnvironmentState(
            served.local(position),
            place,
            Vector3r(0.0, 0.0, -float(served.world.model.opt.gravity[2])),
            pressure,
            temperature,
            pressure / (GAS_CONSTANT * temperature),
        )

    @rpc("getHomeGeoPoint")
    def home(self, vehicle: str) -> GeoPoint:
        """Return where on the earth a vehicle was at the start."""
        served = self._server.find_vehicle(vehicle)
        return served.geo_point(served.origin)

    @rpc("getRotorStates")
    def rotors(self, vehicle: str) -> RotorStates:
        """Return speed, thrust and torque of all rotors: front right, rear left, the other two.

        Those are front left and rear right. The physics has no speeds: they are those of which the
        IMU's vibration is made.
        """
        served = self._server.find_multirotor(vehicle)
        served.state()
        fastest = 2.0 * pi * served.config.imu.vibration.rotor_speed
        rotors = tuple(
            RotorParameters(fastest * sqrt(max(x, 0.0)), x * motor.max_thrust, x * motor.max_torque)
            for x, motor in zip(
                served.physics.thrusts.tolist(), served.physics.parameters.motors, strict=True
            )
        )
        return RotorStates(served.stamp, rotors)
