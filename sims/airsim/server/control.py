"""Methods that take control of a vehicle, and that put it somewhere."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from msgspec.structs import astuple

from events import Arm, Disarm, PoseSetpoint, Reset, Teleport, Vector3
from events.frames import normalize
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.server.vehicles import ServedMultirotor, ServedVehicle
from sims.airsim.structures import KinematicsState, Pose
from sims.vehicle import State
from sims.vehicle.autopilot import FARTHEST

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer


class Control:
    """Control of vehicles."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("enableApiControl")
    def enable_api_control(self, is_enabled: bool, vehicle: str) -> None:
        """Let clients command a vehicle, or not; a vehicle that counts as armed is armed then."""
        served = self._server.find_vehicle(vehicle)
        served.api_control = is_enabled
        if is_enabled and served.armed:
            self._arm(served)

    @rpc("isApiControlEnabled")
    def is_api_control_enabled(self, vehicle: str) -> bool:
        """Return whether clients may command a vehicle."""
        return self._server.find_vehicle(vehicle).api_control

    @rpc("armDisarm")
    def arm_disarm(self, arm: bool, vehicle: str) -> bool:
        """Arm, or stop the motors, in the air too; ``False`` without API control."""
        served = self._server.find_multirotor(vehicle)
        if not served.api_control:
            return False
        served.armed = arm
        if arm:
            self._arm(served)
        elif served.motors_on:
            served.motors_on = False
            self._server.order(Disarm, served)
        return True

    @rpc("reset")
    def reset(self) -> None:
        """Bring all vehicles, objects and the wind back to the start; time goes on."""
        server = self._server
        for vehicle in server.vehicles.values():
            server.tasks.cancel(vehicle.name)
            if isinstance(vehicle, ServedMultirotor):
                server.order(Reset, vehicle)
            else:
                start = vehicle.start
                server.order(
                    PoseSetpoint, vehicle, position=start.position, orientation=start.orientation
                )
            vehicle.release()
            server.collisions.forget(vehicle)
        server.objects.reset()
        server.scenery.reset()

    @rpc("simSetVehiclePose")
    def set_vehicle_pose(self, pose: Pose, ignore_collision: bool, vehicle: str) -> None:  # noqa: ARG002
        """Put a vehicle at rest into a pose, whatever is there; if it flies, it stays there.

        Numbers that are NaN keep what they stand for.
        """
        served = self._server.find_vehicle(vehicle)
        self._put(served, _merged(served, KinematicsState(pose.position, pose.orientation)))

    @rpc("simSetKinematics")
    def set_kinematics(
        self,
        state: KinematicsState,
        ignore_collision: bool,  # noqa: ARG002
        vehicle: str,
    ) -> None:
        """Put a vehicle into a pose with velocities; accelerations are left to the physics.

        Numbers that are NaN keep what they stand for.
        """
        served = self._server.find_vehicle(vehicle)
        self._put(served, _merged(served, state))

    @rpc("simAddVehicle")
    def add_vehicle(self, name: str, vehicle_type: str, pose: Pose, pawn_path: str) -> bool:  # noqa: ARG002
        """Return ``False``: the vehicles of a run are those of its file."""
        return False

    def _put(self, vehicle: ServedVehicle, state: State) -> None:
        server, (position, orientation, linear, angular) = self._server, astuple(state)
        if isinstance(vehicle, ServedMultirotor):
            server.order(
                Teleport,
                vehicle,
                position=position,
                orientation=orientation,
                linear_velocity=linear,
                angular_velocity=angular,
            )
            found = vehicle.physics.state()
            server.collisions.forget(vehicle)
        else:
            if max(map(abs, position)) <= FARTHEST:
                server.order(PoseSetpoint, vehicle, position=position, orientation=orientation)
            found = vehicle.state()
        if found.position != position:
            raise RpcError(
                f"vehicle '{vehicle.name}' cannot be put there: it is too far, too fast, or too "
                "deep inside something, or the vehicle follows a file; see the run's log"
            )

    def _arm(self, vehicle: object) -> None:
        if isinstance(vehicle, ServedMultirotor) and not vehicle.motors_on:
            vehicle.motors_on = True
            self._server.order(Arm, vehicle)


def _merged(vehicle: ServedVehicle, wanted: KinematicsState) -> State:
    """Return a wanted state in ``map``; what of it is NaN is as the vehicle's present one."""
    now = vehicle.state()
    orientation = astuple(wanted.orientation)
    return State(
        _kept(vehicle.in_map(wanted.position), now.position),
        now.orientation if any(map(isnan, orientation)) else normalize(orientation),
        _kept(astuple(wanted.linear_velocity), now.velocity),
        _kept(astuple(wanted.angular_velocity), now.angular_velocity),
    )


def _kept(wanted: Vector3, present: Vector3) -> Vector3:
    x, y, z = (b if isnan(a) else a for a, b in zip(wanted, present, strict=True))
    return x, y, z
