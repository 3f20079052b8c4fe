"""Methods to take control of vehicles, to place them, and to fly them.

Methods to fly reply when their task has ended. Positions are of the vehicle's local frame.
Durations and timeouts are simulated seconds; a task that reaches its timeout has failed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from math import isnan, radians
from typing import Annotated, Any

import msgspec
from msgspec.structs import astuple

from events import Arm, Disarm, MotorSetpoint, PoseSetpoint, Reset, Teleport, Vector3
from events.frames import from_geodetic, from_yaw, normalize, rotate, yaw_of
from sims.vehicle import State
from sims.vehicle.autopilot import FARTHEST
from visnav_airsim.server import moves
from visnav_airsim.server.methods import Finite, RpcError, rpc
from visnav_airsim.server.moves import Reply, Task, Tasks, lookahead_of
from visnav_airsim.server.vehicles import (
    Collisions,
    Commanded,
    ServedMultirotor,
    ServedVehicle,
    Vehicles,
)
from visnav_airsim.wire import KinematicsState, Number, Pose, YawMode

Speed = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]

_FARTHEST = 1e6  # metres to a place on the earth that a vehicle may be sent to
_EARTH = 6371e3  # mean radius, metres
_SLOW = 0.5  # m/s of take-off, hovering and going home
_AHEAD = lookahead_of(-1.0, 1.0, _SLOW)


class Corner(msgspec.Struct, frozen=True):
    """A point of a path, metres."""

    x_val: Number = 0.0
    y_val: Number = 0.0
    z_val: Number = 0.0


class Control:
    """Control of vehicles, and where clients put them; `reset` calls `resets`, too."""

    def __init__(
        self, vehicles: Vehicles, tasks: Tasks, collisions: Collisions, *resets: Callable[[], None]
    ) -> None:
        self._vehicles, self._tasks, self._collisions = vehicles, tasks, collisions
        self._resets = resets

    @rpc("enableApiControl")
    def enable_api_control(self, is_enabled: bool, vehicle: ServedVehicle) -> None:
        """Enable or disable clients' commands; enabling arms vehicles counted as armed."""
        vehicle.api_control = is_enabled
        if is_enabled and vehicle.armed:
            self._arm(vehicle)

    @rpc("isApiControlEnabled")
    def is_api_control_enabled(self, vehicle: ServedVehicle) -> bool:
        """Return whether clients may command a vehicle."""
        return vehicle.api_control

    @rpc("armDisarm")
    def arm_disarm(self, arm: bool, vehicle: ServedMultirotor) -> bool:
        """Arm, or stop the motors, in the air too; ``False`` without API control."""
        if not vehicle.api_control:
            return False
        vehicle.armed = arm
        if arm:
            self._arm(vehicle)
        elif vehicle.motors_on:
            vehicle.motors_on = False
            self._tasks.order(vehicle, Disarm)
        return True

    @rpc("reset")
    def reset(self) -> None:
        """Bring all vehicles, objects and the wind back to the start; time goes on."""
        for vehicle in self._vehicles.values():
            self._tasks.cancel(vehicle)
            if isinstance(vehicle, ServedMultirotor):
                self._tasks.order(vehicle, Reset)
            else:
                self._move(vehicle, vehicle.start)
            vehicle.release()
            self._collisions.forget(vehicle)
        for reset in self._resets:
            reset()

    @rpc("simSetVehiclePose")
    def set_vehicle_pose(self, pose: Pose, ignore_collision: bool, vehicle: ServedVehicle) -> None:  # noqa: ARG002
        """Set a pose, at rest, despite obstacles; in flight, hold the place. NaN keeps a value."""
        self._set_state(vehicle, KinematicsState(pose.position, pose.orientation))

    @rpc("simSetKinematics")
    def set_kinematics(
        self,
        state: KinematicsState,
        ignore_collision: bool,  # noqa: ARG002
        vehicle: ServedVehicle,
    ) -> None:
        """Set pose and velocities; the physics gives accelerations. NaN keeps the present value."""
        self._set_state(vehicle, state)

    @rpc("simAddVehicle")
    def add_vehicle(self, name: str, vehicle_type: str, pose: Pose, pawn_path: str) -> bool:  # noqa: ARG002
        """Return ``False``: the vehicles of a run are those of its file."""
        return False

    def _set_state(self, vehicle: ServedVehicle, target: KinematicsState) -> None:
        state = _merged(vehicle, target)
        if isinstance(vehicle, ServedMultirotor):
            order = partial(
                Teleport,
                position=state.position,
                orientation=state.orientation,
                linear_velocity=state.velocity,
                angular_velocity=state.angular_velocity,
            )
            self._tasks.order(vehicle, order)
            reached = vehicle.physics.state()
            self._collisions.forget(vehicle)
        else:
            if max(map(abs, state.position)) <= FARTHEST:
                self._move(vehicle, state)
            reached = vehicle.state()
        if reached.position != state.position:
            raise RpcError(
                f"vehicle '{vehicle.name}' cannot be put there: it is too far, too fast, or too "
                "deep inside something, or the vehicle follows a file; see the run's log"
            )

    def _move(self, camera: ServedVehicle, to: State) -> None:
        order = partial(PoseSetpoint, position=to.position, orientation=to.orientation)
        self._tasks.order(camera, order)

    def _arm(self, vehicle: ServedVehicle) -> None:
        if isinstance(vehicle, ServedMultirotor) and not vehicle.motors_on:
            vehicle.motors_on = True
            self._tasks.order(vehicle, Arm)


def _merged(vehicle: ServedVehicle, target: KinematicsState) -> State:
    """Return a target state in ``map``; NaN is replaced by the vehicle's present state."""
    now = vehicle.state()
    orientation = astuple(target.orientation)
    return State(
        _or_present(vehicle.in_map(target.position), now.position),
        now.orientation if any(map(isnan, orientation)) else normalize(orientation),
        _or_present(astuple(target.linear_velocity), now.velocity),
        _or_present(astuple(target.angular_velocity), now.angular_velocity),
    )


def _or_present(target: Vector3, present: Vector3) -> Vector3:
    x, y, z = (b if isnan(a) else a for a, b in zip(target, present, strict=True))
    return x, y, z


def _by_velocity(name: str, does: str, *, in_body: bool = False, at_height: bool = False) -> Any:
    """Return the handler of a move at a velocity, whose third argument may be a height."""

    @rpc(name)
    def move(
        self: Flight,
        vx: Number,
        vy: Number,
        vz_or_z: Number,
        duration: Finite,
        drivetrain: int,
        yaw_mode: YawMode,
        vehicle: Commanded,
    ) -> Reply:
        heading = _heading(yaw_mode, drivetrain)
        x, y = vx, vy
        if in_body:
            yaw = yaw_of(vehicle.state().orientation)
            x, y, _ = rotate(from_yaw(yaw), (vx, vy, 0.0))
        task = moves.by_velocity((x, y, vz_or_z), heading, duration)
        if at_height:
            height = vehicle.origin[2] + vz_or_z
            task = moves.by_velocity_at(x, y, height, heading, duration)
        return self.start(vehicle, task)

    move.__doc__ = does
    return move


def _by_attitude(name: str, does: str, *, turns: bool = False, spins: bool = False) -> Any:
    """Return the handler of a move by attitude, whose fourth argument is a height or throttle."""

    @rpc(name)
    def move(
        self: Flight,
        roll: Number,
        pitch: Number,
        yaw: Number,
        z_or_throttle: Number,
        duration: Finite,
        vehicle: Commanded,
    ) -> Reply:
        parameters = vehicle.physics.parameters
        if name.endswith("Z"):
            thrust = moves.at_height(parameters, vehicle.origin[2] + z_or_throttle)
        else:
            share = moves.share_of(parameters, z_or_throttle)
            thrust = lambda _: share  # noqa: E731
        if spins:
            return self.start(vehicle, moves.by_rates((roll, pitch, yaw), thrust, duration))
        now = yaw_of(vehicle.state().orientation)
        angle, rate = (now, _bounded(vehicle, yaw)) if turns else (yaw, 0.0)
        task = moves.by_attitude(roll, pitch, angle, rate, thrust, duration)
        return self.start(vehicle, task)

    move.__doc__ = does
    return move


class Flight:
    """Moves of vehicles.

    Angles of attitudes are FRD in radians as they come: the Python clients have turned pitch and
    yaw already. A throttle is taken as AirSim's quadrotor's, of which 0.587 carries the weight.
    """

    def __init__(self, tasks: Tasks) -> None:
        self.start, self._cancel = tasks.start, tasks.cancel

    by_velocity = _by_velocity("moveByVelocity", "Move at a velocity north, east, down.")
    by_velocity_z = _by_velocity(
        "moveByVelocityZ", "Move at a velocity north and east, at a height.", at_height=True
    )
    by_body_velocity = _by_velocity(
        "moveByVelocityBodyFrame",
        "Move at a velocity forward, right, down, as the vehicle is headed at the start.",
        in_body=True,
    )
    by_body_velocity_z = _by_velocity(
        "moveByVelocityZBodyFrame",
        "Move at a velocity forward and right, as headed at the start, at a height.",
        in_body=True,
        at_height=True,
    )
    by_angles_z = _by_attitude("moveByRollPitchYawZ", "Hold an attitude at a height.")
    by_angles = _by_attitude(
        "moveByRollPitchYawThrottle", "Hold an attitude at a throttle; 0.587 hovers."
    )
    by_yaw_rate_z = _by_attitude(
        "moveByRollPitchYawrateZ", "Hold roll, pitch, yaw rate and height.", turns=True
    )
    by_yaw_rate = _by_attitude(
        "moveByRollPitchYawrateThrottle",
        "Hold roll, pitch and yaw rate at a throttle; 0.587 hovers.",
        turns=True,
    )
    by_rates_z = _by_attitude(
        "moveByAngleRatesZ", "Turn at body rates, at a height as long as tilt allows.", spins=True
    )
    by_rates = _by_attitude(
        "moveByAngleRatesThrottle", "Turn at body rates at a throttle; 0.587 hovers.", spins=True
    )

    @rpc("moveByMotorPWMs")
    def by_motors(
        self,
        front_right: Number,
        rear_left: Number,
        front_left: Number,
        rear_right: Number,
        duration: Finite,
        vehicle: Commanded,
    ) -> Reply:
        """Drive each motor, 0 to 1; 0.587 of all four carries the weight."""
        throttles = front_right, rear_left, front_left, rear_right
        parameters = vehicle.physics.parameters
        a, b, c, d = (moves.share_of(parameters, throttle) for throttle in throttles)
        order = partial(MotorSetpoint, motor1=a, motor2=b, motor3=c, motor4=d)
        return self.start(vehicle, Task(lambda _elapsed, _state: order, duration))

    @rpc("takeoff")
    def takeoff(self, timeout: Finite, vehicle: Commanded) -> Reply:
        """Climb 2 m at 0.5 m/s; an error if the vehicle moves."""
        state = vehicle.state()
        speed = math.hypot(*state.velocity)
        if speed > 0.05:
            raise RpcError(
                "Cannot perform takeoff because vehicle is already moving with velocity "
                f"{speed:f} m/s"
            )
        x, y, z = state.position
        return self._fly_slowly(vehicle, (x, y, z - 2.0), timeout)

    @rpc("land")
    def land(self, timeout: Finite, vehicle: Commanded) -> Reply:
        """Go down at 0.2 m/s, and stop the motors on the ground; the vehicle counts as armed."""
        return self.start(vehicle, moves.landing(timeout))

    @rpc("goHome")
    def go_home(self, timeout: Finite, vehicle: Commanded) -> Reply:
        """Fly straight to where the vehicle was at the start, at 0.5 m/s."""
        return self._fly_slowly(vehicle, vehicle.origin, timeout)

    @rpc("hover")
    def hover(self, vehicle: Commanded) -> Reply:
        """Stop, and hold the place; replies within 0.2 s."""
        return self._fly_slowly(vehicle, vehicle.state().position, math.inf)

    @rpc("cancelLastTask")
    def cancel(self, vehicle: ServedMultirotor) -> None:
        """End the vehicle's task with reply ``False``; the vehicle hovers 60 ms later."""
        self._cancel(vehicle)

    @rpc("moveToPosition")
    def to_position(
        self,
        x: Number,
        y: Number,
        z: Number,
        velocity: Speed,
        timeout: Finite,
        drivetrain: int,
        yaw_mode: YawMode,
        lookahead: Number,
        adaptive: Number,
        vehicle: Commanded,
    ) -> Reply:
        """Fly straight to a position; end within 0.5 m of the position."""
        arguments = velocity, timeout, drivetrain, yaw_mode, lookahead, adaptive, vehicle
        return self.on_path([Corner(x, y, z)], *arguments)

    @rpc("moveToZ")
    def to_height(
        self,
        z: Number,
        velocity: Speed,
        timeout: Finite,
        yaw_mode: YawMode,
        lookahead: Number,
        adaptive: Number,
        vehicle: Commanded,
    ) -> Reply:
        """Fly straight up or down to a height."""
        place = vehicle.local(vehicle.state().position)
        arguments = velocity, timeout, 0, yaw_mode, lookahead, adaptive, vehicle
        return self.on_path([Corner(place.x_val, place.y_val, z)], *arguments)

    @rpc("moveToGPS")
    def to_place_on_earth(
        self,
        latitude: Number,
        longitude: Number,
        altitude: Number,
        velocity: Speed,
        timeout: Finite,
        drivetrain: int,
        yaw_mode: YawMode,
        lookahead: Number,
        adaptive: Number,
        vehicle: Commanded,
    ) -> Reply:
        """Fly straight to a place on the earth, degrees, and metres above the ellipsoid."""
        place = from_geodetic((latitude, longitude, altitude), vehicle.config.origin)
        if (far := math.dist(place, vehicle.origin)) > _FARTHEST:
            arc = 2.0 * _EARTH * math.asin(min(far / (2.0 * _EARTH), 1.0))  # far is straight
            raise RpcError(
                f"expected a place within {_FARTHEST / 1e3:,.0f} km, found it {arc / 1e3:,.0f} km "
                "away: the origin (OriginGeopoint) is "
                "{:.6f}, {:.6f}, {:g} m".format(*vehicle.config.origin)
            )
        corner = Corner(*astuple(vehicle.local(place)))
        arguments = velocity, timeout, drivetrain, yaw_mode, lookahead, adaptive, vehicle
        return self.on_path([corner], *arguments)

    @rpc("moveOnPath")
    def on_path(
        self,
        path: list[Corner],
        velocity: Speed,
        timeout: Finite,
        drivetrain: int,
        yaw_mode: YawMode,
        lookahead: Number,
        adaptive: Number,
        vehicle: Commanded,
    ) -> Reply:
        """Follow a point moving ahead along a path; end within 0.5 m of the last point."""
        if drivetrain == 1 and yaw_mode.is_rate:
            raise RpcError("Yaw cannot be specified as rate if drivetrain is ForwardOnly")
        ahead = lookahead_of(lookahead, adaptive, velocity)
        ox, oy, oz = vehicle.origin
        corners = [(ox + corner.x_val, oy + corner.y_val, oz + corner.z_val) for corner in path]
        points = [vehicle.state().position, *corners]
        heading = _heading(yaw_mode, drivetrain)
        task = moves.along_path(points, velocity, ahead, heading, timeout)
        return self.start(vehicle, task if path else Task(task.steer, 0.0))

    @rpc("rotateToYaw")
    def to_yaw(self, yaw: Number, timeout: Finite, margin: Number, vehicle: Commanded) -> Reply:
        """Hold the place, and turn to a heading in degrees, to within a margin."""
        place = vehicle.state().position
        return self.start(vehicle, moves.to_yaw(place, radians(yaw), radians(margin), timeout))

    @rpc("rotateByYawRate")
    def by_turning(self, yaw_rate: Number, duration: Finite, vehicle: Commanded) -> Reply:
        """Hold the place, and turn at degrees per second, within the vehicle's limits."""
        state = vehicle.state()
        rate, yaw = _bounded(vehicle, radians(yaw_rate)), yaw_of(state.orientation)
        task = moves.by_yaw_rate(state.position, yaw, rate, duration)
        return self.start(vehicle, task)

    def _fly_slowly(self, vehicle: ServedMultirotor, place: Vector3, timeout: float) -> Reply:
        path = [vehicle.state().position, place]
        task = moves.along_path(path, _SLOW, _AHEAD, moves.Heading(), timeout)
        return self.start(vehicle, task)


def _heading(yaw_mode: YawMode, drivetrain: int) -> moves.Heading:
    """Return where to look; `drivetrain` is 1 for ``ForwardOnly``."""
    return moves.Heading(drivetrain == 1, yaw_mode.is_rate, radians(yaw_mode.yaw_or_rate))


def _bounded(vehicle: ServedMultirotor, yaw_rate: float) -> float:
    limit: float = vehicle.config.limits.yaw_rate
    return min(max(yaw_rate, -limit), limit)
