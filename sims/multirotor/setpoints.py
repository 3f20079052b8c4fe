"""Which set-points there are, and which of them cannot be followed. No control."""

from __future__ import annotations

from math import isfinite

from events import AttitudeSetpoint, BodyRateSetpoint, PositionSetpoint, VelocitySetpoint

Setpoint = PositionSetpoint | VelocitySetpoint | AttitudeSetpoint | BodyRateSetpoint
"""What the cascade can follow."""


def fault(setpoint: Setpoint) -> str | None:
    """Return what is wrong with a set-point, None if nothing is."""
    match setpoint:
        case PositionSetpoint():
            total = sum(setpoint.position) + sum(setpoint.velocity) + sum(setpoint.acceleration)
            total += setpoint.yaw + setpoint.yaw_rate
        case VelocitySetpoint():
            if setpoint.frame_id not in ("map", "heading"):
                return (
                    "VelocitySetpoint.frame_id: expected 'map' or 'heading', "
                    f"found {setpoint.frame_id!r}"
                )
            total = sum(setpoint.velocity) + setpoint.yaw_rate
        case AttitudeSetpoint():
            if not sum(component * component for component in setpoint.orientation) > 1e-12:
                return (
                    "AttitudeSetpoint.orientation: expected a unit quaternion, "
                    f"found {setpoint.orientation}"
                )
            total = sum(setpoint.orientation) + setpoint.thrust
        case BodyRateSetpoint():
            total = sum(setpoint.angular_velocity) + setpoint.thrust
    # One number that is not finite makes the sum so.
    if not isfinite(total):
        return f"{type(setpoint).__name__}: expected finite numbers, found {setpoint}"
    return None
