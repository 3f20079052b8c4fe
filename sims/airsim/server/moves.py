"""What vehicles can be told to do, as pure tasks: time and state in, set-points out.

Positions and velocities are of ``map``. The rules are AirSim's; see docs/reference/airsim.md for
what differs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from math import atan2, cos, pi, radians, sin

import msgspec

from events import Land, PositionSetpoint, Vector3, VelocitySetpoint
from events.rotations import yaw_of
from sims.airsim.server.carrot import CLOSE, Carrot, braked
from sims.airsim.server.tasks import RATE, Order, Task
from sims.airsim.structures import YawMode
from sims.vehicle import State

_STILL = 0.05
"""Metres per second that count as none."""
_YAW_GAIN = 3.0
"""Yaw rate per angle of error, 1/s."""
_HEIGHT_GAIN = 1.5
"""Vertical velocity per metre of error, 1/s."""
_FASTEST = 6.0
"""Metres per second at which a height is gone to, as AirSim's controller limits it."""


class Heading(msgspec.Struct, frozen=True):
    """Where to look on the way.

    Attributes:
        follows: Whether the vehicle looks where it goes (AirSim's ``ForwardOnly``), if the mode is
            an angle; which is then added.
        mode: An angle or a rate, in degrees.
    """

    follows: bool = False
    mode: YawMode = YawMode()

    def rate(self, state: State, x: float, y: float) -> float:
        """Return the yaw rate (rad/s) for a vehicle that goes along (x, y) in ``map``."""
        angle = radians(self.mode.yaw_or_rate)
        if self.mode.is_rate:
            return angle
        if self.follows:
            if math.hypot(x, y) <= CLOSE:
                return 0.0
            angle += atan2(y, x)
        return _YAW_GAIN * _wrapped(angle - yaw_of(state.orientation))


def by_velocity(velocity: Vector3, heading: Heading, duration: float) -> Task:
    """Move at a velocity (m/s) for some seconds."""

    def steer(_: float, state: State) -> Order:
        return _velocity(velocity, heading.rate(state, velocity[0], velocity[1]))

    return Task(steer, duration)


def by_velocity_at(x: float, y: float, height: float, heading: Heading, duration: float) -> Task:
    """Move at a horizontal velocity (m/s), and at a height (z, m), for some seconds."""

    def steer(_: float, state: State) -> Order:
        velocity = (x, y, _to_height(state, height, _FASTEST))
        return _velocity(velocity, heading.rate(state, x, y))

    return Task(steer, duration, duration > 0.0)


def along_path(
    path: Sequence[Vector3], velocity: float, lookahead: float, heading: Heading, timeout: float
) -> Task:
    """Fly along a path from its first point, where the vehicle is, to its last.

    It has succeeded at the end of the path when there is no progress any more; it has failed if
    there is none for a second elsewhere with the carrot at the end, or at the timeout.
    """
    return Task(_AlongPath(path, velocity, lookahead, heading).steer, timeout, at_limit=False)


class _AlongPath:
    def __init__(
        self, path: Sequence[Vector3], velocity: float, lookahead: float, heading: Heading
    ) -> None:
        self._carrot = Carrot(path, lookahead)
        self._end = path[-1]
        self._velocity = velocity
        self._heading = heading
        self._least = min(_STILL, 0.1 * velocity) / RATE
        self._idle = 0
        self._nearest = math.inf

    def steer(self, _: float, state: State) -> Order | bool:
        carrot = self._carrot
        before = carrot.progress
        target = carrot.advance(state.position)
        x, y, z = (a - b for a, b in zip(target, state.position, strict=True))
        apart = math.hypot(x, y, z)
        if carrot.is_last:
            is_going = carrot.progress - before > self._least
            self._idle = 0 if is_going else self._idle + 1
            if apart <= CLOSE or carrot.progress >= carrot.length:
                if not is_going:
                    return True
            elif self._idle >= RATE:
                return False
        is_near = carrot.is_last and apart <= CLOSE
        speed = braked(self._velocity, carrot.length - carrot.progress)
        share = 0.0 if is_near else speed / apart
        down = z * share
        if is_near or abs(z) <= CLOSE:
            down = _to_height(state, target[2], self._velocity)
        return _velocity((x * share, y * share, down), self._heading.rate(state, x, y))


def landing() -> Callable[[float, State], Order | None]:
    """Return how to go down at 0.2 m/s until something stops that, and then to stop the motors."""
    idle = 0

    def steer(_: float, state: State) -> Order | None:
        nonlocal idle
        if idle > 10:
            return None
        idle = idle + 1 if state.velocity[2] <= _STILL else 0
        return Land if idle > 10 else _velocity((0.0, 0.0, 0.2), 0.0)

    return steer


def to_yaw(place: Vector3, yaw: float, margin: float, timeout: float) -> Task:
    """Hold a place (m), and look to a yaw, until it is met to a margin (both radians)."""

    def steer(_: float, state: State) -> Order | bool:
        error = abs(_wrapped(yaw - yaw_of(state.orientation)))
        if error <= margin and abs(state.angular_velocity[2]) <= 0.01:
            return True
        return functools.partial(PositionSetpoint, position=place, yaw=yaw)

    return Task(steer, timeout, at_limit=False)


def by_yaw_rate(place: Vector3, yaw: float, rate: float, duration: float) -> Task:
    """Hold a place (m), and turn from a yaw at a rate (rad/s) for some seconds."""

    def steer(elapsed: float, _: State) -> Order:
        return functools.partial(
            PositionSetpoint, position=place, yaw=_wrapped(yaw + rate * elapsed), yaw_rate=rate
        )

    return Task(steer, duration)


def turned(x: float, y: float, yaw: float) -> tuple[float, float]:
    """Return a horizontal vector of the heading's frame in ``map``."""
    return x * cos(yaw) - y * sin(yaw), x * sin(yaw) + y * cos(yaw)


def _velocity(velocity: Vector3, yaw_rate: float) -> Order:
    return functools.partial(VelocitySetpoint, velocity=velocity, yaw_rate=yaw_rate)


def _to_height(state: State, height: float, fastest: float) -> float:
    """Return the vertical velocity (m/s, down) that brings a vehicle to a height (z, m)."""
    return min(max(_HEIGHT_GAIN * (height - state.position[2]), -fastest), fastest)


def _wrapped(angle: float) -> float:
    """Return an angle in [-π, π)."""
    return (angle + pi) % (2.0 * pi) - pi
