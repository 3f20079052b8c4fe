"""The set-points that the control can follow, and a check of their values."""

from __future__ import annotations

from events import AttitudeSetpoint, BodyRateSetpoint, PositionSetpoint, VelocitySetpoint

Setpoint = PositionSetpoint | VelocitySetpoint | AttitudeSetpoint | BodyRateSetpoint
"""What the cascade can follow."""

MOST = 1e6
"""In SI units; squares of much greater numbers would overflow in the control loops."""


def fault(setpoint: Setpoint) -> str | None:
    """Return what is wrong with a set-point, None if nothing is."""
    match setpoint:
        case PositionSetpoint():
            numbers = [*setpoint.position, *setpoint.velocity, *setpoint.acceleration]
            numbers += [setpoint.yaw, setpoint.yaw_rate]
        case VelocitySetpoint():
            if setpoint.frame_id not in ("map", "heading"):
                return (
                    "VelocitySetpoint.frame_id: expected 'map' or 'heading', "
                    f"found {setpoint.frame_id!r}"
                )
            numbers = [*setpoint.velocity, setpoint.yaw_rate]
        case AttitudeSetpoint():
            numbers = [setpoint.thrust]
        case BodyRateSetpoint():
            numbers = [*setpoint.angular_velocity, setpoint.thrust]
    if not all(-MOST <= number <= MOST for number in numbers):
        return f"{type(setpoint).__name__}: expected numbers up to {MOST:g}, found {setpoint}"
    return None
