"""The cascade's inner loops: attitude to body rates to torque, and four motor commands out.

The outer ones are in `position`; whether the vehicle may fly is `autopilot`'s business.
"""

from __future__ import annotations

from math import atan2, sqrt

import msgspec
import numpy as np

import events as ev
from events import Quaternion, Vector3
from events.frames import inverse, multiply, normalize, yaw_of
from sims.vehicle.physics import State
from sims.vehicle.position import (
    Derivative,
    Gains,
    Limits,
    PositionController,
    clip,
    shortened,
    wrapped,
)
from sims.vehicle.simulation import Mixer, VehicleParameters


class AttitudeController:
    """Quaternion attitude control with priority of tilt over yaw.

    The error is split into the shortest turn that brings the thrust where it should point and a
    turn about it (D. Brescianini, R. D'Andrea, *Tilt-prioritized quadrocopter attitude control*,
    IEEE TCST 2018), so that a large yaw error does not bend the path.
    """

    def __init__(self, gains: Gains, limits: Limits) -> None:
        self._gains = gains
        self._limits = limits

    def update(self, orientation: Quaternion, target: Quaternion, yaw_rate: float) -> Vector3:
        """Return the body rates (rad/s, FRD) to a target, a yaw rate about down fed forward."""
        ew, ex, ey, ez = multiply(inverse(orientation), target)  # the turn, seen from the body
        # error = swing ⊗ twist, the twist about z; the swing is never more than half a turn
        twist = sqrt(ew * ew + ez * ez)
        if twist > 1e-6:
            sx = (ew * ex - ey * ez) / twist
            sy = (ew * ey + ex * ez) / twist
            turn = wrapped(2.0 * atan2(ez, ew))
        else:  # upside down: any way round is as short, and yaw says nothing
            sx, sy, turn = ex, ey, 0.0
        gain = 2.0 * self._gains.tilt
        rx, ry = shortened(gain * sx, gain * sy, self._limits.tilt_rate)
        rz = clip(self._gains.yaw * turn, self._limits.yaw_rate)
        if yaw_rate:  # about the world's z, whose coordinates in the body are the last row of R
            w, x, y, z = orientation
            rx += yaw_rate * 2.0 * (x * z - w * y)
            ry += yaw_rate * 2.0 * (y * z + w * x)
            rz += yaw_rate * (1.0 - 2.0 * (x * x + y * y))
        return rx, ry, rz


class BodyRateController:
    """PID on body rates, with the derivative of the measurement and the gyroscopic torque."""

    _INTEGRAL = 10.0  # limit of an integrator, rad/s²

    def __init__(self, parameters: VehicleParameters, gains: Gains) -> None:
        self._inertia = parameters.inertia
        level = gains.rate_xy_p, gains.rate_xy_i, gains.rate_xy_d
        self._gains = (level, level, (gains.rate_z_p, gains.rate_z_i, 0.0))
        self._derivative = Derivative(gains.derivative_cutoff)
        self.reset()

    def reset(self) -> None:
        """Forget integrals and the last measurement."""
        self._integrals = [0.0, 0.0, 0.0]
        self._derivative.reset()

    def update(self, rates: Vector3, target: Vector3, dt: float) -> Vector3:
        """Return the torque (N m, FRD) to bring `rates` to `target` (both rad/s, FRD)."""
        slopes = self._derivative.update(rates, dt)
        wanted = []
        for axis, (p, i, d) in enumerate(self._gains):
            error = target[axis] - rates[axis]
            self._integrals[axis] = clip(self._integrals[axis] + i * dt * error, self._INTEGRAL)
            wanted.append(p * error + self._integrals[axis] - d * slopes[axis])
        (ax, ay, az), (wx, wy, wz), (jx, jy, jz) = wanted, rates, self._inertia
        # J α + ω × J ω, Euler's equations
        return (
            jx * ax + (jz - jy) * wy * wz,
            jy * ay + (jx - jz) * wz * wx,
            jz * az + (jy - jx) * wx * wy,
        )


Motors = tuple[float, float, float, float]  # motor commands, 0 to 1 of each motor's thrust


class Controller:
    """Follows the newest set-point, whatever its kind.

    Position and velocity set-points go through the whole cascade and its limits. Attitude and
    body-rate set-points enter further down: of the limits only those on body rates hold for them,
    and the thrust is theirs. Motor set-points pass all of it by.
    """

    def __init__(
        self,
        parameters: VehicleParameters,
        gains: Gains | None = None,
        limits: Limits | None = None,
    ) -> None:
        gains = gains or Gains()
        limits = limits or Limits()
        self.position = PositionController(parameters, gains, limits)
        self.attitude = AttitudeController(gains, limits)
        self.rates = BodyRateController(parameters, gains)
        self.mixer = Mixer(parameters)
        self._limits = limits
        self._max_thrust = parameters.max_thrust
        self._order: Setpoint | None = None  # None: `position`, by itself

    def reset(self) -> None:
        """Forget the integrals and last measurements of a flight."""
        self.position.reset()
        self.rates.reset()
        if isinstance(self._order, ev.VelocitySetpoint):
            self._order = None

    def follow(self, setpoint: Setpoint, state: State) -> None:
        """Follow a set-point (of velocity: heading of `state`); `ValueError` for a `fault`."""
        reason = fault(setpoint)
        if reason is not None:
            raise ValueError(reason)
        before = self._order
        if isinstance(setpoint, ev.AttitudeSetpoint):
            turn = normalize(setpoint.orientation)
            setpoint = msgspec.structs.replace(setpoint, orientation=turn)
        self._switch(setpoint)
        if isinstance(setpoint, ev.PositionSetpoint):
            self.position.to_position(
                setpoint.position,
                setpoint.velocity,
                setpoint.acceleration,
                setpoint.yaw,
                setpoint.yaw_rate,
            )
        elif isinstance(setpoint, ev.VelocitySetpoint):
            # Renewed set-points turn on from where the last one has turned to.
            turning = isinstance(before, ev.VelocitySetpoint)
            yaw = self.position.yaw if turning else yaw_of(state.orientation)
            self.position.to_velocity(
                setpoint.velocity, yaw, setpoint.yaw_rate, setpoint.frame_id == "heading"
            )

    def hold(self, position: Vector3, velocity: Vector3, yaw: float) -> None:
        """Fly to a position (m, NED) with a velocity (m/s, NED), for the autopilot's manoeuvres."""
        self._switch(None)
        self.position.to_position(position, velocity, yaw=yaw)

    def brake(self, state: State, vertical_velocity: float = 0.0) -> None:
        """Stop and hold the place, or only climb or sink (m/s, NED); keep the heading."""
        self._switch(None)
        self.position.brake(yaw_of(state.orientation), vertical_velocity)

    def update(self, state: State, dt: float) -> Motors:
        """Return the motor commands for now."""
        match order := self._order:
            case ev.MotorSetpoint():
                a, b, c, d = (_share(getattr(order, name)) for name in _NUMBERS[type(order)])
                return a, b, c, d
            case ev.AttitudeSetpoint():
                thrust = _share(order.thrust) * self._max_thrust
                rates = self.attitude.update(state.orientation, order.orientation, 0.0)
            case ev.BodyRateSetpoint():
                thrust = _share(order.thrust) * self._max_thrust
                x, y, z = order.angular_velocity
                tilt, yaw = self._limits.tilt_rate, self._limits.yaw_rate
                rates = clip(x, tilt), clip(y, tilt), clip(z, yaw)
            case _:
                target, thrust, yaw_rate = self.position.update(state, dt)
                rates = self.attitude.update(state.orientation, target, yaw_rate)
        torque = self.rates.update(state.angular_velocity, rates, dt)
        return self.mixer.mix(thrust, *torque)

    def _switch(self, order: Setpoint | None) -> None:
        """Take an order; states of loops that have stood still are stale."""
        if isinstance(self._order, ev.MotorSetpoint):
            self.rates.reset()
        if isinstance(self._order, _Direct) and not isinstance(order, _Direct):
            self.position.reset()
        self._order = order


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))


Setpoint = (
    ev.PositionSetpoint
    | ev.VelocitySetpoint
    | ev.AttitudeSetpoint
    | ev.BodyRateSetpoint
    | ev.MotorSetpoint
)
"""Set-points accepted by the cascade."""

_Direct = ev.AttitudeSetpoint | ev.BodyRateSetpoint | ev.MotorSetpoint  # past the outer loops

MOST = 1e6  # in SI units; squares of much greater numbers would overflow in the control loops

_NUMBERS: dict[type[Setpoint], tuple[str, ...]] = {
    ev.PositionSetpoint: ("position", "velocity", "acceleration", "yaw", "yaw_rate"),
    ev.VelocitySetpoint: ("velocity", "yaw_rate"),
    ev.AttitudeSetpoint: ("thrust",),
    ev.BodyRateSetpoint: ("angular_velocity", "thrust"),
    ev.MotorSetpoint: ("motor1", "motor2", "motor3", "motor4"),
}
"""Fields of set-points that must be numbers up to `MOST`."""


def fault(setpoint: Setpoint) -> str | None:
    """Return the error in a set-point, or None."""
    if isinstance(setpoint, ev.VelocitySetpoint) and setpoint.frame_id not in ("map", "heading"):
        return (
            f"VelocitySetpoint.frame_id: expected 'map' or 'heading', found {setpoint.frame_id!r}"
        )
    numbers = np.hstack([getattr(setpoint, name) for name in _NUMBERS[type(setpoint)]])
    if not (np.abs(numbers) <= MOST).all():
        return f"{type(setpoint).__name__}: expected numbers up to {MOST:g}, found {setpoint}"
    return None
