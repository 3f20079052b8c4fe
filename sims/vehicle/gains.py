"""Settings of the controller: gains of the cascade and limits of the flight."""

from __future__ import annotations

from math import radians
from typing import Annotated

import msgspec

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
    """Limits that the cascade keeps, whatever the set-point.

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
