"""The outer loops: from position or velocity to attitude and thrust; gains and limits.

Position P with feed-forward → velocity PID → acceleration → thrust vector and yaw → attitude, NED.
"""

from __future__ import annotations

from math import asin, atan2, cos, pi, radians, sin, sqrt, tan
from typing import Annotated

import msgspec

from events import Quaternion, Vector3
from events.frames import from_rpy, yaw_of
from sims.vehicle.model import VehicleParameters
from sims.vehicle.physics import State

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


class PositionController:
    """Controller of position or velocity, with a single target at a time.

    Thrust vector to attitude: D. Mellinger, V. Kumar, *Minimum snap trajectory generation and
    control for quadrotors*, ICRA 2011, with the yaw of the ZYX angles as heading even when tilted,
    as in PX4.
    """

    __slots__ = (
        "_ax", "_ay", "_az", "_braking", "_cutoff", "_dx", "_dy", "_dz", "_gains", "_gravity",
        "_heading_frame", "_hold_xy", "_hold_z", "_ix", "_iy", "_iz", "_lift_max", "_lift_min",
        "_limits", "_lvx", "_lvy", "_lvz", "_mass", "_px", "_py", "_pz", "_specific_max",
        "_started", "_tan_tilt", "_thrust_max", "_vx", "_vy", "_vz", "_yaw_rate", "yaw",
    )  # fmt: skip

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
        self._cutoff = 2.0 * pi * gains.derivative_cutoff
        self._px = self._py = self._pz = 0.0
        self._vx = self._vy = self._vz = 0.0
        self._ax = self._ay = self._az = 0.0
        self.yaw = self._yaw_rate = 0.0
        self._hold_xy = self._hold_z = self._braking = self._heading_frame = False
        self.reset()

    def reset(self) -> None:
        """Forget integrals and the last measurement; the target stays."""
        self._ix = self._iy = self._iz = 0.0
        self._dx = self._dy = self._dz = 0.0
        self._lvx = self._lvy = self._lvz = 0.0
        self._started = False

    def to_position(
        self,
        position: Vector3,
        velocity: Vector3 = (0.0, 0.0, 0.0),
        acceleration: Vector3 = (0.0, 0.0, 0.0),
        yaw: float = 0.0,
        yaw_rate: float = 0.0,
    ) -> None:
        """Fly to a position (m, NED), with a velocity, acceleration and yaw expected there."""
        self._px, self._py, self._pz = position
        self._vx, self._vy, self._vz = velocity
        self._ax, self._ay, self._az = acceleration
        self.yaw = yaw
        self._yaw_rate = yaw_rate
        self._hold_xy = self._hold_z = True
        self._braking = self._heading_frame = False

    def to_velocity(
        self, velocity: Vector3, yaw: float, yaw_rate: float = 0.0, heading_frame: bool = False
    ) -> None:
        """Move at a velocity (m/s NED, or right of the heading), from `yaw` on at `yaw_rate`."""
        self._vx, self._vy, self._vz = velocity
        self._ax = self._ay = self._az = 0.0
        self.yaw = yaw
        limit = self._limits.yaw_rate
        self._yaw_rate = min(limit, max(-limit, yaw_rate))
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
        x, y, z = state.position
        vx, vy, vz = state.velocity
        yaw = self.yaw
        if self._braking:
            self._take_hold(x, y, z, vx, vy, vz)
        if not self._hold_xy and self._yaw_rate:
            yaw += self._yaw_rate * dt
            if yaw > pi:
                yaw -= 2.0 * pi
            elif yaw < -pi:
                yaw += 2.0 * pi
            self.yaw = yaw

        # Position to velocity. Far away the speed follows the parabola that ends in the place at
        # the approach's deceleration; near it is proportional (the "square root controller").
        tx = self._vx
        ty = self._vy
        if self._hold_xy:
            ex = self._px - x
            ey = self._py - y
            gain = gains.position_xy
            distance = sqrt(ex * ex + ey * ey)
            near = limits.approach / (gain * gain)
            if distance > near:
                gain = sqrt(2.0 * limits.approach * (distance - 0.5 * near)) / distance
            tx += gain * ex
            ty += gain * ey
        elif self._heading_frame:
            heading = yaw_of(state.orientation)
            c = cos(heading)
            s = sin(heading)
            tx, ty = c * tx - s * ty, s * tx + c * ty
        square = tx * tx + ty * ty
        if square > limits.speed * limits.speed:
            scale = limits.speed / sqrt(square)
            tx *= scale
            ty *= scale
        tz = self._vz
        if self._hold_z:
            ez = self._pz - z
            gain = gains.position_z
            distance = abs(ez)
            near = limits.approach / (gain * gain)
            if distance > near:
                gain = sqrt(2.0 * limits.approach * (distance - 0.5 * near)) / distance
            tz += gain * ez
        if tz > limits.descent:
            tz = limits.descent
        elif tz < -limits.climb:
            tz = -limits.climb

        # Velocity to acceleration; derivatives of what is measured, so that steps do not kick.
        dx = self._dx
        dy = self._dy
        dz = self._dz
        if self._started:
            share = self._cutoff * dt
            share /= 1.0 + share
            self._dx = dx = dx + share * ((vx - self._lvx) / dt - dx)
            self._dy = dy = dy + share * ((vy - self._lvy) / dt - dy)
            self._dz = dz = dz + share * ((vz - self._lvz) / dt - dz)
        else:
            self._started = True
        self._lvx = vx
        self._lvy = vy
        self._lvz = vz
        ex = tx - vx
        ey = ty - vy
        ez = tz - vz
        kp = gains.velocity_xy_p
        kd = gains.velocity_xy_d
        # The derivative opposes acceleration that nobody asked for, not the feed-forward's.
        ax = self._ax + kp * ex + self._ix - kd * (dx - self._ax)
        ay = self._ay + kp * ey + self._iy - kd * (dy - self._ay)
        az = (
            self._az + gains.velocity_z_p * ez + self._iz - gains.velocity_z_d * (dz - self._az)
        )  # fmt: skip

        # Acceleration to thrust: the vertical first, then what tilt and motors leave. Integrators
        # stand still while what they would add is cut off anyway.
        bound = limits.integral
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
            self._iz = min(bound, max(-bound, self._iz + gain * ez))
        reach = min(self._tan_tilt * lift, sqrt(self._specific_max**2 - lift * lift))
        square = ax * ax + ay * ay
        wind = True
        if square > reach * reach:
            scale = reach / sqrt(square)
            wind = ax * ex + ay * ey < 0.0
            ax *= scale
            ay *= scale
        if wind:
            gain = gains.velocity_xy_i * dt / (1.0 + (ex * ex + ey * ey) / _LARGE)
            self._ix = min(bound, max(-bound, self._ix + gain * ex))
            self._iy = min(bound, max(-bound, self._iy + gain * ey))

        # Thrust vector and yaw to attitude: z of the body is -f/|f|, here in the heading's frame.
        c = cos(yaw)
        s = sin(yaw)
        norm = sqrt(ax * ax + ay * ay + lift * lift)
        target = from_rpy(asin((c * ay - s * ax) / norm), atan2(-(c * ax + s * ay), lift), yaw)
        # Only the part of it along the body's present z axis is thrust in the right direction.
        qw, qx, qy, qz = state.orientation
        thrust = self._mass * (
            lift * (1.0 - 2.0 * (qx * qx + qy * qy))
            - ax * 2.0 * (qx * qz + qw * qy)
            - ay * 2.0 * (qy * qz - qw * qx)
        )
        return target, min(self._thrust_max, max(0.0, thrust)), self._yaw_rate

    def _take_hold(self, x: float, y: float, z: float, vx: float, vy: float, vz: float) -> None:
        if not self._hold_xy and vx * vx + vy * vy < _STILL * _STILL:
            self._px = x
            self._py = y
            self._hold_xy = True
        if not self._hold_z and self._vz == 0.0 and abs(vz) < _STILL:
            self._pz = z
            self._hold_z = True
        self._braking = not (self._hold_xy and (self._hold_z or self._vz != 0.0))
