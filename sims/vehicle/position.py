"""The outer loops: from position or velocity to attitude and thrust; gains and limits.

Position P with feed-forward → velocity PID → acceleration → thrust vector and yaw → attitude, NED.
"""

from __future__ import annotations

from math import asin, atan2, cos, pi, radians, sin, sqrt, tan
from typing import Annotated

import msgspec

from events import Quaternion, Vector3
from events.frames import from_rpy, yaw_of
from sims.vehicle.physics import State
from sims.vehicle.simulation import VehicleParameters

Factor = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Tilt = Annotated[float, msgspec.Meta(gt=0, lt=1.5)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Gains(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Gains of the cascade, for a vehicle whose motors lag by about 40 ms.

    None depends on mass, inertia or thrust: those come from the vehicle's parameters.

    Attributes:
        position_xy: Velocity per position error, 1/s.
        position_z: The same for the vertical, 1/s.
        velocity_xy_p: Acceleration per velocity error, 1/s.
        velocity_xy_i: Acceleration per integrated velocity error, 1/s².
        velocity_xy_d: Acceleration per measured acceleration, which it opposes; without unit.
        velocity_z_p: As `velocity_xy_p`, for the vertical, 1/s.
        velocity_z_i: As `velocity_xy_i`, for the vertical, 1/s².
        velocity_z_d: As `velocity_xy_d`, for the vertical, without unit.
        tilt: Body rate per angle of tilt error, 1/s.
        yaw: Body rate per angle of yaw error, 1/s.
        rate_xy_p: Angular acceleration per error in roll or pitch rate, 1/s.
        rate_xy_i: Angular acceleration per integrated error, 1/s².
        rate_xy_d: Angular acceleration per measured angular acceleration, without unit.
        rate_z_p: As `rate_xy_p`, for the yaw rate, 1/s.
        rate_z_i: As `rate_xy_i`, for the yaw rate, 1/s².
        derivative_cutoff: Cut-off frequency of the low-pass filter on every derivative, Hz.
    """

    position_xy: Positive = 1.5
    position_z: Positive = 2.0
    velocity_xy_p: Positive = 3.4
    velocity_xy_i: Factor = 1.0
    velocity_xy_d: Factor = 0.1
    velocity_z_p: Positive = 6.0
    velocity_z_i: Factor = 2.0
    velocity_z_d: Factor = 0.0
    tilt: Factor = 8.0
    yaw: Factor = 3.0
    rate_xy_p: Factor = 20.0
    rate_xy_i: Factor = 10.0
    rate_xy_d: Factor = 0.4
    rate_z_p: Factor = 6.0
    rate_z_i: Factor = 2.0
    derivative_cutoff: Positive = 40.0


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of the control cascade, for all set-points.

    Attributes:
        tilt: Angle between the thrust and the vertical in position and velocity flight, radians.
        speed: Horizontal speed, metres per second.
        climb: Speed upwards, metres per second.
        descent: Speed downwards, metres per second.
        approach: Deceleration towards a position, metres per second squared.
        integral: Acceleration that the velocity integrators may add, metres per second squared.
        tilt_rate: Angular velocity about x and y, radians per second.
        yaw_rate: Angular velocity about z, radians per second.
        min_thrust: Least thrust in position and velocity flight, as a share of the motors' maximum.
        max_thrust: Greatest upward thrust there, as a share of the same; the rest is for steering.
    """

    tilt: Tilt = radians(35.0)
    speed: Positive = 12.0
    climb: Positive = 4.0
    descent: Positive = 2.0
    approach: Positive = 3.0
    integral: Factor = 3.0
    tilt_rate: Positive = 8.0
    yaw_rate: Positive = 2.0
    min_thrust: Share = 0.08
    max_thrust: Share = 0.9

    def __post_init__(self) -> None:
        if not self.min_thrust < self.max_thrust:
            raise ValueError(
                f"min_thrust: expected less than max_thrust, {self.max_thrust:g}, found "
                f"{self.min_thrust:g}"
            )


_STILL = 0.2  # speed of a braking vehicle at the start of position hold, metres per second

_LARGE = 0.5 * 0.5
"""Square of the velocity error (m/s) that halves the learning rate: a manoeuvre is no wind."""


def clip(value: float, limit: float) -> float:
    """Return a number within a limit either way."""
    return min(limit, max(-limit, value))


def shortened(x: float, y: float, longest: float) -> tuple[float, float]:
    """Return a vector of the same direction, no longer than a limit."""
    square = x * x + y * y
    if square <= longest * longest:
        return x, y
    scale = longest / sqrt(square)
    return x * scale, y * scale


def wrapped(angle: float) -> float:
    """Return an angle of up to a turn and a half as one of up to half a turn, radians."""
    if angle > pi:
        return angle - 2.0 * pi
    return angle + 2.0 * pi if angle < -pi else angle


class Derivative:
    """Derivative of a measured vector, through a low-pass filter; zero until the second."""

    def __init__(self, cutoff: float) -> None:
        self._cutoff = 2.0 * pi * cutoff  # given in Hz
        self.reset()

    def reset(self) -> None:
        """Forget the measurements."""
        self._before: Vector3 | None = None
        self._value: Vector3 = (0.0, 0.0, 0.0)

    def update(self, measured: Vector3, dt: float) -> Vector3:
        """Return the derivative at a measurement, `dt` seconds after the last one."""
        if self._before is not None:
            share = self._cutoff * dt
            share /= 1.0 + share
            x, y, z = (
                value + share * ((now - before) / dt - value)
                for value, now, before in zip(self._value, measured, self._before, strict=True)
            )
            self._value = (x, y, z)
        self._before = measured
        return self._value


class PositionController:
    """Controller of position or velocity, with a single target at a time.

    Thrust vector to attitude: D. Mellinger, V. Kumar, *Minimum snap trajectory generation and
    control for quadrotors*, ICRA 2011, with the yaw of the ZYX angles as heading even when tilted,
    as in PX4.
    """

    def __init__(self, parameters: VehicleParameters, gains: Gains, limits: Limits) -> None:
        self._gains = gains
        self._limits = limits
        self._mass = parameters.mass
        self._gravity = parameters.gravity
        self._thrust_max = parameters.max_thrust
        self._specific_max = parameters.max_thrust / parameters.mass
        self._lift_min = limits.min_thrust * self._specific_max
        self._lift_max = limits.max_thrust * self._specific_max
        self._tan_tilt = tan(limits.tilt)
        self._derivative = Derivative(gains.derivative_cutoff)
        self._place = self._velocity = self._acceleration = (0.0, 0.0, 0.0)
        self.yaw = self._yaw_rate = 0.0
        self._hold_xy = self._hold_z = self._braking = self._heading_frame = False
        self.reset()

    def reset(self) -> None:
        """Forget integrals and the last measurement; the target stays."""
        self._ix = self._iy = self._iz = 0.0
        self._derivative.reset()

    def to_position(
        self,
        position: Vector3,
        velocity: Vector3 = (0.0, 0.0, 0.0),
        acceleration: Vector3 = (0.0, 0.0, 0.0),
        yaw: float = 0.0,
        yaw_rate: float = 0.0,
    ) -> None:
        """Fly to a position (m, NED), with a velocity, acceleration and yaw expected there."""
        self._place, self._velocity, self._acceleration = position, velocity, acceleration
        self.yaw, self._yaw_rate = yaw, yaw_rate
        self._hold_xy = self._hold_z = True
        self._braking = self._heading_frame = False

    def to_velocity(
        self, velocity: Vector3, yaw: float, yaw_rate: float = 0.0, heading_frame: bool = False
    ) -> None:
        """Move at a velocity (m/s NED, or right of the heading), from `yaw` on at `yaw_rate`."""
        self._velocity, self._acceleration = velocity, (0.0, 0.0, 0.0)
        self.yaw, self._yaw_rate = yaw, clip(yaw_rate, self._limits.yaw_rate)
        self._hold_xy = self._hold_z = self._braking = False
        self._heading_frame = heading_frame

    def brake(self, yaw: float, vertical_velocity: float = 0.0) -> None:
        """Stop and hold the place reached, or only climb or sink (m/s, NED)."""
        self.to_velocity((0.0, 0.0, vertical_velocity), yaw)
        self._braking = True

    def update(self, state: State, dt: float) -> tuple[Quaternion, float, float]:
        """Return the attitude (FRD → NED), the thrust (N) and the yaw rate (rad/s) to fly now."""
        gains = self._gains
        limits = self._limits
        if self._braking:
            self._take_hold(state)
        if not self._hold_xy and self._yaw_rate:
            self.yaw = wrapped(self.yaw + self._yaw_rate * dt)
        tx, ty, tz = self._wanted_velocity(state)

        # Velocity to acceleration; derivatives of what is measured, so that steps do not kick. The
        # derivative opposes acceleration that nobody asked for, not the feed-forward's.
        vx, vy, vz = state.velocity
        dx, dy, dz = self._derivative.update(state.velocity, dt)
        ax, ay, az = self._acceleration
        ex, ey, ez = tx - vx, ty - vy, tz - vz
        kp, kd = gains.velocity_xy_p, gains.velocity_xy_d
        ax = ax + kp * ex + self._ix - kd * (dx - ax)
        ay = ay + kp * ey + self._iy - kd * (dy - ay)
        az = az + gains.velocity_z_p * ez + self._iz - gains.velocity_z_d * (dz - az)

        # Acceleration to thrust: the vertical first, then what tilt and motors leave. Integrators
        # stand still while what they would add is cut off anyway.
        lift = self._gravity - az
        if lift > self._lift_max:
            lift = self._lift_max
            wind = ez > 0.0
        elif lift < self._lift_min:
            lift = self._lift_min
            wind = ez < 0.0
        else:
            wind = True
        if wind:
            gain = gains.velocity_z_i * dt / (1.0 + ez * ez / _LARGE)
            self._iz = clip(self._iz + gain * ez, limits.integral)
        reach = min(self._tan_tilt * lift, sqrt(self._specific_max**2 - lift * lift))
        cut = ax * ax + ay * ay > reach * reach
        if not cut or ax * ex + ay * ey < 0.0:
            gain = gains.velocity_xy_i * dt / (1.0 + (ex * ex + ey * ey) / _LARGE)
            self._ix = clip(self._ix + gain * ex, limits.integral)
            self._iy = clip(self._iy + gain * ey, limits.integral)
        ax, ay = shortened(ax, ay, reach)

        # Thrust vector and yaw to attitude: z of the body is -f/|f|, here in the heading's frame.
        c, s = cos(self.yaw), sin(self.yaw)
        norm = sqrt(ax * ax + ay * ay + lift * lift)
        roll, pitch = asin((c * ay - s * ax) / norm), atan2(-(c * ax + s * ay), lift)
        # Only the part of it along the body's present z axis is thrust in the right direction.
        qw, qx, qy, qz = state.orientation
        thrust = self._mass * (
            lift * (1.0 - 2.0 * (qx * qx + qy * qy))
            - ax * 2.0 * (qx * qz + qw * qy)
            - ay * 2.0 * (qy * qz - qw * qx)
        )
        target = from_rpy(roll, pitch, self.yaw)
        return target, min(self._thrust_max, max(0.0, thrust)), self._yaw_rate

    def _wanted_velocity(self, state: State) -> Vector3:
        gains, limits = self._gains, self._limits
        x, y, z = state.position
        px, py, pz = self._place
        vx, vy, vz = self._velocity
        if self._hold_xy:
            ex, ey = px - x, py - y
            gain = self._approach(gains.position_xy, sqrt(ex * ex + ey * ey))
            vx += gain * ex
            vy += gain * ey
        elif self._heading_frame:
            heading = yaw_of(state.orientation)
            c, s = cos(heading), sin(heading)
            vx, vy = c * vx - s * vy, s * vx + c * vy
        vx, vy = shortened(vx, vy, limits.speed)
        if self._hold_z:
            ez = pz - z
            vz += self._approach(gains.position_z, abs(ez)) * ez
        return vx, vy, max(-limits.climb, min(limits.descent, vz))

    def _approach(self, gain: float, distance: float) -> float:
        """Return the velocity per position error at a distance (the "square root controller").

        Far away the speed follows the parabola that ends in the place at the approach's
        deceleration; near it is proportional.
        """
        deceleration = self._limits.approach
        near = deceleration / (gain * gain)
        if distance > near:
            return sqrt(2.0 * deceleration * (distance - 0.5 * near)) / distance
        return gain

    def _take_hold(self, state: State) -> None:
        (x, y, z), (vx, vy, vz) = state.position, state.velocity
        stops = self._velocity[2] == 0.0
        if not self._hold_xy and vx * vx + vy * vy < _STILL * _STILL:
            self._place = (x, y, self._place[2])
            self._hold_xy = True
        if not self._hold_z and stops and abs(vz) < _STILL:
            self._place = (*self._place[:2], z)
            self._hold_z = True
        self._braking = not (self._hold_xy and (self._hold_z or not stops))
