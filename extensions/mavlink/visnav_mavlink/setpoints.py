"""Offboard messages as set-points of the vehicle, each bit of their masks by itself.

A number whose bit is set, or that is NaN, is ignored. What the vehicle has no set-point for (a
height to hold at a horizontal velocity, a heading beside a velocity, a yaw rate beside an attitude)
is made anew at every step from where the vehicle is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import events as ev
from events import Setpoint
from events.frames import from_yaw, inverse, multiply, yaw_of
from visnav_mavlink.links import mav
from visnav_mavlink.vehicle import GLOBAL_FRAMES, SECOND, Vehicle

YAW_GAIN = 1.5  # of a heading that is asked for beside a velocity, 1/s
PLACE_GAIN = 1.5  # of a coordinate that is held beside a velocity, 1/s
FASTEST = 2.0  # towards such a coordinate, metres per second
_BODY = {mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED, mav.MAV_FRAME_BODY_FRD}
_NED = {mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_OFFSET_NED}
_FORCE, _NO_YAW, _NO_YAW_RATE = 1 << 9, 1 << 10, 1 << 11
_NO_RATES, _THRUST_BODY, _NO_THRUST, _NO_ATTITUDE = 0b111, 1 << 5, 1 << 6, 1 << 7


class ConvertedSetpoint(NamedTuple):
    """A set-point.

    Attributes:
        depends: Whether it depends on the vehicle's state, so that it has to be made again.
        dropped: What of the message is not followed; empty for nothing.
    """

    kind: type[Setpoint]
    fields: dict[str, Any]
    depends: bool = False
    dropped: str = ""


class Offboard:
    """The newest message of an offboard program, as a set-point."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._message: Any = None
        self.stamp = -(1 << 62)
        self._turned: tuple[int, float] | None = None  # stamp and heading beside a yaw rate

    def accept(self, message: Any, now: int) -> ConvertedSetpoint:
        """Store and convert a message; a `ValueError` says why it cannot be followed."""
        setpoint = self._convert(message, now)
        self._message, self.stamp = message, now
        return setpoint

    def renew(self, now: int, all_of_them: bool = False) -> ConvertedSetpoint | None:
        """Convert the newest message again, if its set-point depends on the vehicle's state."""
        try:
            setpoint = None if self._message is None else self._convert(self._message, now)
        except ValueError:  # it was followed, but the vehicle is too far away by now
            return None
        return setpoint if setpoint is not None and (all_of_them or setpoint.depends) else None

    def _convert(self, message: Any, now: int) -> ConvertedSetpoint:
        if message.get_type() == "SET_ATTITUDE_TARGET":
            return self._attitude(message, now)
        self._turned = None
        return self._target(message)

    def _target(self, message: Any) -> ConvertedSetpoint:
        mask, frame, vehicle = message.type_mask, message.coordinate_frame, self._vehicle
        if message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
            frames: Any = GLOBAL_FRAMES
            numbers = message.lat_int, message.lon_int, message.alt
        else:
            frames, numbers = _NED | _BODY, (message.x, message.y, message.z)
        if frame not in frames:
            raise ValueError(f"expected a coordinate_frame of {sorted(frames)}, found {frame}")
        place = _unmasked(numbers, mask)
        velocity = _unmasked((message.vx, message.vy, message.vz), mask >> 3)
        acceleration = _unmasked((message.afx, message.afy, message.afz), mask >> 6)
        yaw, yaw_rate = _unmasked((message.yaw, message.yaw_rate), mask >> 10)
        if mask & _FORCE and not all(map(math.isnan, acceleration)):
            raise ValueError("forces are not followed")
        current_yaw = yaw_of(vehicle.orientation)
        turn = _or_zero(yaw_rate)
        fixed = [not math.isnan(coordinate) for coordinate in place]
        if not any(fixed) and all(map(math.isnan, velocity)):
            raise ValueError("expected a position or a velocity, found neither")
        speeds = [_or_zero(speed) for speed in velocity]
        if any(fixed):
            if frame in _BODY or frame == mav.MAV_FRAME_LOCAL_OFFSET_NED:
                raise ValueError(f"expected a place in frame LOCAL_NED, found frame {frame}")
            position = vehicle.place_of(frame, place[0], place[1], place[2])
            if all(fixed):
                fields = {
                    "position": position,
                    "velocity": tuple(speeds),
                    "acceleration": tuple(map(_or_zero, acceleration)),
                    "yaw": current_yaw if math.isnan(yaw) else yaw,
                    "yaw_rate": turn,
                }
                return ConvertedSetpoint(
                    ev.PositionSetpoint, fields, math.isnan(yaw) and turn != 0.0
                )
            for axis in range(3):
                if fixed[axis]:
                    speed = PLACE_GAIN * (position[axis] - vehicle.position[axis])
                    speeds[axis] += min(max(speed, -FASTEST), FASTEST)
        if not math.isnan(yaw):
            turn += YAW_GAIN * math.remainder(yaw - current_yaw, math.tau)
        fields = {
            "velocity": tuple(speeds),
            "yaw_rate": turn,
            "frame_id": "heading" if frame in _BODY else "map",
        }
        dropped = "accelerations beside velocities" if any(map(_or_zero, acceleration)) else ""
        return ConvertedSetpoint(
            ev.VelocitySetpoint, fields, any(fixed) or not math.isnan(yaw), dropped
        )

    def _attitude(self, message: Any, now: int) -> ConvertedSetpoint:
        mask, thrust = message.type_mask, message.thrust
        if mask & _THRUST_BODY:
            raise ValueError("expected a thrust, found thrust_body")
        if mask & _NO_THRUST or not math.isfinite(thrust):
            raise ValueError("expected a thrust, found it ignored")
        numbers = message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate
        rates = tuple(map(_or_zero, _unmasked(numbers, mask)))
        if mask & _NO_ATTITUDE:
            self._turned = None
            if mask & _NO_RATES == _NO_RATES:
                raise ValueError("expected an attitude or rates, found neither")
            return ConvertedSetpoint(
                ev.BodyRateSetpoint, {"angular_velocity": rates, "thrust": thrust}
            )
        size = math.hypot(*message.q)
        if not (math.isfinite(size) and size > 0.5):
            raise ValueError("expected a quaternion of length one")
        w, x, y, z = (part / size for part in message.q)
        orientation, heading = (w, x, y, z), yaw_of((w, x, y, z))
        if turn := rates[2]:
            if self._turned is not None:
                before, heading = self._turned
                heading += turn * (now - before) / SECOND
            self._turned = now, heading
            level = multiply(inverse(from_yaw(yaw_of(orientation))), orientation)
            orientation = multiply(from_yaw(heading), level)
        else:
            self._turned = None
        dropped = "roll and pitch rates beside an attitude" if any(rates[:2]) else ""
        fields = {"orientation": orientation, "thrust": thrust}
        return ConvertedSetpoint(ev.AttitudeSetpoint, fields, bool(turn), dropped)


def _unmasked(values: tuple[float, ...], mask: int) -> tuple[float, ...]:
    """Return numbers, with NaN where a mask's bit is set; a `ValueError` for infinite ones."""
    if any(map(math.isinf, values)):
        raise ValueError("expected numbers, found infinite ones")
    return tuple(math.nan if mask >> bit & 1 else value for bit, value in enumerate(values))


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value
