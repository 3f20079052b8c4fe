"""Methods that let a vehicle fly; each replies when its task has ended.

Positions are of the vehicle's local frame. Durations and timeouts are simulated seconds; a task
that reaches its timeout has failed.
"""

from __future__ import annotations

import functools
import math
from math import radians
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from events import MotorSetpoint, Vector3
from events.frames import from_geodetic, from_yaw, rotate, yaw_of
from sims.airsim.server import moves
from sims.airsim.server.carrot import lookahead_of
from sims.airsim.server.methods import Finite, RpcError, rpc
from sims.airsim.server.tasks import Reply, Task
from sims.airsim.server.vehicles import ServedMultirotor

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""In SI units or degrees; no vehicle goes farther or faster."""
Speed = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]

_SLOW = 0.5
"""Metres per second of take-off, hovering and going home."""
_AHEAD = lookahead_of(-1.0, 1.0, _SLOW)


class Corner(msgspec.Struct, frozen=True):
    """A point of a path, metres."""

    x_val: Number = 0.0
    y_val: Number = 0.0
    z_val: Number = 0.0


class YawMode(msgspec.Struct, frozen=True):
    """A heading in degrees, or degrees per second; clockwise from north seen from above."""

    is_rate: bool = True
    yaw_or_rate: Number = 0.0

    def heading(self, drivetrain: int) -> moves.Heading:
        """Return where to look; `drivetrain` is 1 for ``ForwardOnly``."""
        return moves.Heading(drivetrain == 1, self.is_rate, radians(self.yaw_or_rate))


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
        vehicle_name: str,
    ) -> Reply:
        vehicle = self.tasks.commanded(vehicle_name)
        heading = yaw_mode.heading(drivetrain)
        x, y = vx, vy
        if in_body:
            yaw = yaw_of(vehicle.state().orientation)
            x, y, _ = rotate(from_yaw(yaw), (vx, vy, 0.0))
        task = moves.by_velocity((x, y, vz_or_z), heading, duration)
        if at_height:
            height = vehicle.origin[2] + vz_or_z
            task = moves.by_velocity_at(x, y, height, heading, duration)
        return self.tasks.start(vehicle, task)

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
        vehicle_name: str,
    ) -> Reply:
        vehicle = self.tasks.commanded(vehicle_name)
        parameters = vehicle.physics.parameters
        if name.endswith("Z"):
            thrust = moves.at_height(parameters, vehicle.origin[2] + z_or_throttle)
        else:
            thrust = moves.at_throttle(parameters, z_or_throttle)
        if spins:
            return self.tasks.start(vehicle, moves.by_rates((roll, pitch, yaw), thrust, duration))
        now = yaw_of(vehicle.state().orientation)
        angle, rate = (now, _bounded(vehicle, yaw)) if turns else (yaw, 0.0)
        task = moves.by_attitude(roll, pitch, angle, rate, thrust, duration)
        return self.tasks.start(vehicle, task)

    move.__doc__ = does
    return move


class Flight:
    """Moves of vehicles.

    Angles of attitudes are FRD in radians as they come: the Python clients have turned pitch and
    yaw already. A throttle is taken as AirSim's quadrotor's, of which 0.587 carries the weight.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self.tasks = server.tasks

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
        vehicle_name: str,
    ) -> Reply:
        """Drive each motor, 0 to 1; 0.587 of all four carries the weight."""
        vehicle = self.tasks.commanded(vehicle_name)
        share = functools.partial(moves.share_of, vehicle.physics.parameters)
        order = functools.partial(
            MotorSetpoint,
            motor1=share(front_right),
            motor2=share(rear_left),
            motor3=share(front_left),
            motor4=share(rear_right),
        )
        return self.tasks.start(vehicle, Task(lambda _elapsed, _state: order, duration))

    @rpc("takeoff")
    def takeoff(self, timeout: Finite, vehicle_name: str) -> Reply:
        """Climb 2 m at 0.5 m/s; an error if the vehicle moves."""
        vehicle = self.tasks.commanded(vehicle_name)
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
    def land(self, timeout: Finite, vehicle_name: str) -> Reply:
        """Go down at 0.2 m/s, and stop the motors on the ground; the vehicle counts as armed."""
        return self.tasks.start(self.tasks.commanded(vehicle_name), moves.landing(timeout))

    @rpc("goHome")
    def go_home(self, timeout: Finite, vehicle_name: str) -> Reply:
        """Fly straight to where the vehicle was at the start, at 0.5 m/s."""
        vehicle = self.tasks.commanded(vehicle_name)
        return self._fly_slowly(vehicle, vehicle.origin, timeout)

    @rpc("hover")
    def hover(self, vehicle_name: str) -> Reply:
        """Stop, and hold the place; replies within 0.2 s."""
        vehicle = self.tasks.commanded(vehicle_name)
        return self._fly_slowly(vehicle, vehicle.state().position, math.inf)

    @rpc("cancelLastTask")
    def cancel(self, vehicle_name: str) -> None:
        """End the vehicle's task, whose reply is ``False``; it hovers 60 ms later."""
        self.tasks.cancel(self._server.find_multirotor(vehicle_name).name)

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
        vehicle_name: str,
    ) -> Reply:
        """Fly straight to a position; ends within 0.5 m of it."""
        how = velocity, timeout, drivetrain, yaw_mode, lookahead, adaptive, vehicle_name
        return self.on_path([Corner(x, y, z)], *how)

    @rpc("moveToZ")
    def to_height(
        self,
        z: Number,
        velocity: Speed,
        timeout: Finite,
        yaw_mode: YawMode,
        lookahead: Number,
        adaptive: Number,
        vehicle_name: str,
    ) -> Reply:
        """Fly straight up or down to a height."""
        vehicle = self.tasks.commanded(vehicle_name)
        place = vehicle.local(vehicle.state().position)
        how = velocity, timeout, 0, yaw_mode, lookahead, adaptive, vehicle_name
        return self.on_path([Corner(place.x_val, place.y_val, z)], *how)

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
        vehicle_name: str,
    ) -> Reply:
        """Fly straight to a place on the earth, degrees, and metres above the ellipsoid."""
        vehicle = self.tasks.commanded(vehicle_name)
        place = from_geodetic((latitude, longitude, altitude), vehicle.config.origin)
        if math.dist(place, vehicle.origin) > 1e6:
            raise RpcError("expected a place within 1000 km")
        local = vehicle.local(place)
        how = velocity, timeout, drivetrain, yaw_mode, lookahead, adaptive, vehicle_name
        return self.on_path([Corner(local.x_val, local.y_val, local.z_val)], *how)

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
        vehicle_name: str,
    ) -> Reply:
        """Follow a point that runs ahead along a path; ends within 0.5 m of the last point."""
        vehicle = self.tasks.commanded(vehicle_name)
        if drivetrain == 1 and yaw_mode.is_rate:
            raise RpcError("Yaw cannot be specified as rate if drivetrain is ForwardOnly")
        ahead = lookahead_of(lookahead, adaptive, velocity)
        ox, oy, oz = vehicle.origin
        corners = [(ox + each.x_val, oy + each.y_val, oz + each.z_val) for each in path]
        whole = [vehicle.state().position, *corners]
        heading = yaw_mode.heading(drivetrain)
        task = moves.along_path(whole, velocity, ahead, heading, timeout)
        return self.tasks.start(vehicle, task if path else Task(task.steer, 0.0))

    @rpc("rotateToYaw")
    def to_yaw(self, yaw: Number, timeout: Finite, margin: Number, vehicle_name: str) -> Reply:
        """Hold the place, and turn to a heading in degrees until it is met to a margin."""
        vehicle = self.tasks.commanded(vehicle_name)
        place = vehicle.state().position
        task = moves.to_yaw(place, radians(yaw), radians(margin), timeout)
        return self.tasks.start(vehicle, task)

    @rpc("rotateByYawRate")
    def by_turning(self, yaw_rate: Number, duration: Finite, vehicle_name: str) -> Reply:
        """Hold the place, and turn at degrees per second, within the vehicle's limits."""
        vehicle = self.tasks.commanded(vehicle_name)
        state = vehicle.state()
        rate, yaw = _bounded(vehicle, radians(yaw_rate)), yaw_of(state.orientation)
        return self.tasks.start(vehicle, moves.by_yaw_rate(state.position, yaw, rate, duration))

    def _fly_slowly(self, vehicle: ServedMultirotor, place: Vector3, timeout: float) -> Reply:
        path = [vehicle.state().position, place]
        task = moves.along_path(path, _SLOW, _AHEAD, moves.Heading(), timeout)
        return self.tasks.start(vehicle, task)


def _bounded(vehicle: ServedMultirotor, yaw_rate: float) -> float:
    """Return a yaw rate that the vehicle reaches, so that the heading does not run away."""
    limit: float = vehicle.config.limits.yaw_rate
    return min(max(yaw_rate, -limit), limit)
