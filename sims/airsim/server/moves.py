"""What vehicles can be told to do, as pure tasks: time and state in, set-points out.

Positions and velocities are of ``map``, angles in radians. The rules are AirSim's; what differs is
in docs/reference/airsim.md.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from math import pi

from events import (
    AttitudeSetpoint,
    BodyRateSetpoint,
    Land,
    PositionSetpoint,
    Vector3,
    VelocitySetpoint,
)
from events.frames import from_rpy, yaw_of
from sims.airsim.server.carrot import CLOSE, Carrot, braked
from sims.airsim.server.tasks import RATE, Order, Task
from sims.vehicle import State, VehicleParameters

HOVER_THROTTLE = 9.80665 / (4.0 * 4.18)
"""Throttle at which AirSim's quadrotor hovers: 1 kg on four rotors of 4.18 N."""

Thrust = Callable[[State], float]
"""Gives the thrust, 0 to 1 of what all motors can give together."""

_STILL = 0.05
"""Metres per second that count as none."""
_SLOW = 0.2
"""Metres per second with which a path may end: what comes next begins where it ended."""
_SETTLING = 5
"""Updates without progress near the end after which a path has ended."""
_STUCK = 5 * RATE
"""Updates without progress after which a path has failed."""
_GAIN = 1.5
"""Vertical velocity per metre of error, 1/s."""
_LIFT_GAIN = 4.0
"""Vertical acceleration per error in velocity, 1/s."""
_YAW_GAIN = 3.0
"""Yaw rate per angle of error, 1/s."""
_FASTEST = 6.0
"""Metres per second at which a height is gone to, as AirSim's controller limits it."""


class Heading:
    """Where to look on the way.

    Args:
        follows: Whether to look where the vehicle goes (AirSim's ``ForwardOnly``), unless at a
            rate; the angle is then added.
        is_rate: Whether the angle is a rate, in radians per second.
        angle: See `is_rate`.
    """

    def __init__(self, follows: bool = False, is_rate: bool = True, angle: float = 0.0) -> None:
        self._follows, self._is_rate, self._angle = follows, is_rate, angle

    def rate(self, state: State, x: float, y: float) -> float:
        """Return the yaw rate (rad/s) for a vehicle that goes along (x, y)."""
        if self._is_rate:
            return self._angle
        if self._follows and math.hypot(x, y) <= CLOSE:
            return 0.0
        course = math.atan2(y, x) if self._follows else 0.0
        return _YAW_GAIN * wrapped(course + self._angle - yaw_of(state.orientation))


def by_velocity(velocity: Vector3, heading: Heading, duration: float) -> Task:
    """Move at a velocity (m/s) for some seconds."""
    x, y, _ = velocity
    return Task(lambda _, state: _velocity(velocity, heading.rate(state, x, y)), duration)


def by_velocity_at(x: float, y: float, height: float, heading: Heading, duration: float) -> Task:
    """Move at a horizontal velocity (m/s), and at a height (z, m), for some seconds."""

    def steer(_: float, state: State) -> Order:
        return _velocity((x, y, _to_height(state, height)), heading.rate(state, x, y))

    return Task(steer, duration, duration > 0.0)


def along_path(
    path: Sequence[Vector3], speed: float, lookahead: float, heading: Heading, timeout: float
) -> Task:
    """Fly along a path (m) from its first point, where the vehicle is, to its last.

    It has succeeded when there is no progress any more within 0.5 m of the end, and hardly any
    speed; it has failed if there is no progress for 5 s elsewhere (where AirSim waits for the
    timeout), or at the timeout.
    """
    carrot, least, idle = Carrot(path, lookahead), min(_STILL, 0.1 * speed) / RATE, 0

    def steer(_: float, state: State) -> Order | bool:
        nonlocal idle
        before = carrot.progress
        target = carrot.advance(state.position)
        x, y, z = (a - b for a, b in zip(target, state.position, strict=True))
        apart, remaining = math.hypot(x, y, z), carrot.length - carrot.progress
        is_near = carrot.is_last and apart <= CLOSE
        idle = idle + 1 if carrot.progress - before <= least else 0
        is_there = is_near or not remaining
        is_slow = math.hypot(*state.velocity) <= _SLOW
        if idle > (_SETTLING if is_there and is_slow else _STUCK):
            return is_there
        share = 0.0 if is_near else braked(speed, remaining) / max(apart, CLOSE)
        down = _to_height(state, target[2], speed) if abs(z) <= CLOSE else z * share
        return _velocity((x * share, y * share, down), heading.rate(state, x, y))

    return Task(steer, timeout, at_limit=False)


def landing(timeout: float) -> Task:
    """Go down at 0.2 m/s until something stops that for 0.2 s, and then stop the motors."""
    idle = 0

    def steer(_: float, state: State) -> Order | None:
        nonlocal idle
        if idle > 10:
            return None
        idle = idle + 1 if state.velocity[2] <= _STILL else 0
        return Land if idle > 10 else _velocity((0.0, 0.0, 0.2), 0.0)

    return Task(steer, timeout, at_limit=False)


def to_yaw(place: Vector3, yaw: float, margin: float, timeout: float) -> Task:
    """Hold a place (m), and turn to a yaw until it is met to a margin."""

    def steer(_: float, state: State) -> Order | bool:
        error = abs(wrapped(yaw - yaw_of(state.orientation)))
        if error <= margin and abs(state.angular_velocity[2]) <= 0.01:
            return True
        return functools.partial(PositionSetpoint, position=place, yaw=wrapped(yaw))

    return Task(steer, timeout, at_limit=False)


def by_yaw_rate(place: Vector3, yaw: float, rate: float, duration: float) -> Task:
    """Hold a place (m), and turn from a yaw at a rate (rad/s) for some seconds."""
    turn = functools.partial(PositionSetpoint, position=place, yaw_rate=rate)
    return Task(
        lambda elapsed, _: functools.partial(turn, yaw=wrapped(yaw + rate * elapsed)), duration
    )


def by_attitude(
    roll: float, pitch: float, yaw: float, yaw_rate: float, thrust: Thrust, duration: float
) -> Task:
    """Hold an attitude, whose yaw turns on at a rate (rad/s), for some seconds."""

    def steer(elapsed: float, state: State) -> Order:
        attitude = from_rpy(roll, pitch, yaw + yaw_rate * elapsed)
        return functools.partial(AttitudeSetpoint, orientation=attitude, thrust=thrust(state))

    return Task(steer, duration)


def by_rates(rates: Vector3, thrust: Thrust, duration: float) -> Task:
    """Turn at body rates (rad/s) for some seconds."""
    order = functools.partial(BodyRateSetpoint, angular_velocity=rates)
    return Task(lambda _, state: functools.partial(order, thrust=thrust(state)), duration)


def at_height(parameters: VehicleParameters, height: float) -> Thrust:
    """Return the thrust that brings a vehicle to a height (z, m), and holds it there."""

    def thrust(state: State) -> float:
        down = _LIFT_GAIN * (_to_height(state, height) - state.velocity[2])
        _, x, y, _ = state.orientation
        upright = max(1.0 - 2.0 * (x * x + y * y), 0.3)  # the part of it against the weight
        share = parameters.hover_thrust * (1.0 - down / parameters.gravity) / upright
        return min(max(share, 0.0), 1.0)

    return thrust


def at_throttle(parameters: VehicleParameters, throttle: float) -> Thrust:
    """Return the thrust of a throttle of AirSim's quadrotor."""
    share = share_of(parameters, throttle)
    return lambda _: share


def share_of(parameters: VehicleParameters, throttle: float) -> float:
    """Return the share of our motors' thrust for a throttle of AirSim's quadrotor.

    It is the same multiple of the weight.
    """
    return min(max(throttle, 0.0), 1.0) * parameters.hover_thrust / HOVER_THROTTLE


def wrapped(angle: float) -> float:
    """Return an angle in [-π, π)."""
    return (angle + pi) % (2.0 * pi) - pi


def _velocity(velocity: Vector3, yaw_rate: float) -> Order:
    return functools.partial(VelocitySetpoint, velocity=velocity, yaw_rate=yaw_rate)


def _to_height(state: State, height: float, fastest: float = _FASTEST) -> float:
    """Return the vertical velocity (m/s, down) that brings a vehicle to a height (z, m)."""
    return min(max(_GAIN * (height - state.position[2]), -fastest), fastest)
