"""The cascade's inner loops: attitude to body rates to torque, and four motor commands out.

The outer ones are in `position`; whether the vehicle may fly is `autopilot`'s business.
"""

from __future__ import annotations

from math import atan2, pi, sqrt

import events as ev
from events import Quaternion, Vector3
from events.frames import normalize, yaw_of
from sims.vehicle.model import Mixer, VehicleParameters
from sims.vehicle.physics import State
from sims.vehicle.position import Gains, Limits, PositionController


class AttitudeController:
    """Quaternion attitude control with priority of tilt over yaw.

    The error is split into the shortest turn that brings the thrust where it should point and a
    turn about it (D. Brescianini, R. D'Andrea, *Tilt-prioritized quadrocopter attitude control*,
    IEEE TCST 2018), so that a large yaw error does not bend the path.
    """

    __slots__ = ("_tilt", "_tilt_rate", "_yaw", "_yaw_rate")

    def __init__(self, gains: Gains, limits: Limits) -> None:
        self._tilt = gains.tilt
        self._yaw = gains.yaw
        self._tilt_rate = limits.tilt_rate
        self._yaw_rate = limits.yaw_rate

    def update(self, orientation: Quaternion, target: Quaternion, yaw_rate: float) -> Vector3:
        """Return the body rates (rad/s, FRD) to a target, a yaw rate about down fed forward."""
        w, x, y, z = orientation
        tw, tx, ty, tz = target
        # error = orientation⁻¹ ⊗ target: the turn still to make, seen from the body
        ew = w * tw + x * tx + y * ty + z * tz
        ex = w * tx - x * tw - y * tz + z * ty
        ey = w * ty + x * tz - y * tw - z * tx
        ez = w * tz - x * ty + y * tx - z * tw
        # error = swing ⊗ twist, the twist about z; the swing is never more than half a turn
        twist = sqrt(ew * ew + ez * ez)
        if twist > 1e-6:
            sx = (ew * ex - ey * ez) / twist
            sy = (ew * ey + ex * ez) / twist
            turn = 2.0 * atan2(ez, ew)
            if turn > pi:
                turn -= 2.0 * pi
            elif turn < -pi:
                turn += 2.0 * pi
        else:  # upside down: any way round is as short, and yaw says nothing
            sx, sy, turn = ex, ey, 0.0
        gain = 2.0 * self._tilt
        rx = gain * sx
        ry = gain * sy
        limit = self._tilt_rate
        square = rx * rx + ry * ry
        if square > limit * limit:
            scale = limit / sqrt(square)
            rx *= scale
            ry *= scale
        rz = self._yaw * turn
        limit = self._yaw_rate
        if rz > limit:
            rz = limit
        elif rz < -limit:
            rz = -limit
        if yaw_rate:  # about the world's z, whose coordinates in the body are the last row of R
            rx += yaw_rate * 2.0 * (x * z - w * y)
            ry += yaw_rate * 2.0 * (y * z + w * x)
            rz += yaw_rate * (1.0 - 2.0 * (x * x + y * y))
        return rx, ry, rz


class BodyRateController:
    """PID on body rates, with the derivative of the measurement and the gyroscopic torque."""

    __slots__ = (
        "_cutoff", "_dx", "_dy", "_ix", "_iy", "_iz", "_jx", "_jy", "_jz", "_kd", "_ki", "_kiz",
        "_kp", "_kpz", "_started", "_wx", "_wy",
    )  # fmt: skip

    _INTEGRAL = 10.0  # limit of an integrator, rad/s²

    def __init__(self, parameters: VehicleParameters, gains: Gains) -> None:
        self._jx, self._jy, self._jz = parameters.inertia
        self._kp = gains.rate_xy_p
        self._ki = gains.rate_xy_i
        self._kd = gains.rate_xy_d
        self._kpz = gains.rate_z_p
        self._kiz = gains.rate_z_i
        self._cutoff = 2.0 * pi * gains.derivative_cutoff
        self.reset()

    def reset(self) -> None:
        """Forget integrals and the last measurement."""
        self._ix = self._iy = self._iz = 0.0
        self._dx = self._dy = 0.0
        self._wx = self._wy = 0.0
        self._started = False

    def update(self, rates: Vector3, target: Vector3, dt: float) -> Vector3:
        """Return the torque (N m, FRD) to bring `rates` to `target` (both rad/s, FRD)."""
        wx, wy, wz = rates
        tx, ty, tz = target
        if self._started:
            share = self._cutoff * dt
            share /= 1.0 + share
            dx = self._dx
            dx += share * ((wx - self._wx) / dt - dx)
            dy = self._dy
            dy += share * ((wy - self._wy) / dt - dy)
            self._dx = dx
            self._dy = dy
        else:
            dx = dy = 0.0
            self._started = True
        self._wx = wx
        self._wy = wy
        ex = tx - wx
        ey = ty - wy
        ez = tz - wz
        bound = self._INTEGRAL
        gain = self._ki * dt
        self._ix = ix = min(bound, max(-bound, self._ix + gain * ex))
        self._iy = iy = min(bound, max(-bound, self._iy + gain * ey))
        self._iz = iz = min(bound, max(-bound, self._iz + self._kiz * dt * ez))
        jx = self._jx
        jy = self._jy
        jz = self._jz
        kp = self._kp
        kd = self._kd
        # J α + ω × J ω, Euler's equations
        return (
            jx * (kp * ex + ix - kd * dx) + (jz - jy) * wy * wz,
            jy * (kp * ey + iy - kd * dy) + (jx - jz) * wz * wx,
            jz * (self._kpz * ez + iz) + (jy - jx) * wx * wy,
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
        self._in_position = True
        self._in_velocity = False
        self._target: Quaternion | None = None
        self._target_rates: Vector3 = (0.0, 0.0, 0.0)
        self._thrust = 0.0
        self._motors: Motors | None = None

    def reset(self) -> None:
        """Forget the integrals and last measurements of a flight."""
        self.position.reset()
        self.rates.reset()
        self._in_velocity = False

    def follow(self, setpoint: Setpoint, state: State) -> None:
        """Follow a set-point (of velocity: heading of `state`); `ValueError` for a `fault`."""
        reason = fault(setpoint)
        if reason is not None:
            raise ValueError(reason)
        match setpoint:
            case ev.PositionSetpoint():
                self._take_over()
                self.position.to_position(
                    setpoint.position,
                    setpoint.velocity,
                    setpoint.acceleration,
                    setpoint.yaw,
                    setpoint.yaw_rate,
                )
            case ev.VelocitySetpoint():
                # Renewed set-points turn on from where the last one has turned to.
                yaw = self.position.yaw if self._in_velocity else yaw_of(state.orientation)
                self._take_over()
                self._in_velocity = True
                self.position.to_velocity(
                    setpoint.velocity, yaw, setpoint.yaw_rate, setpoint.frame_id == "heading"
                )
            case ev.AttitudeSetpoint():
                self._target = normalize(setpoint.orientation)
                self._take_thrust(setpoint.thrust)
            case ev.BodyRateSetpoint():
                tilt, yaw = self._limits.tilt_rate, self._limits.yaw_rate
                x, y, z = setpoint.angular_velocity
                self._target = None
                self._target_rates = (_clip(x, tilt), _clip(y, tilt), _clip(z, yaw))
                self._take_thrust(setpoint.thrust)
            case ev.MotorSetpoint():
                a, b, c, d = setpoint.motor1, setpoint.motor2, setpoint.motor3, setpoint.motor4
                self._take_thrust(0.0)
                self._motors = (_share(a), _share(b), _share(c), _share(d))

    def hold(self, position: Vector3, velocity: Vector3, yaw: float) -> None:
        """Fly to a position (m, NED) with a velocity (m/s, NED), for the autopilot's manoeuvres."""
        self._take_over()
        self.position.to_position(position, velocity, yaw=yaw)

    def brake(self, state: State, vertical_velocity: float = 0.0) -> None:
        """Stop and hold the place, or only climb or sink (m/s, NED); keep the heading."""
        self._take_over()
        self.position.brake(yaw_of(state.orientation), vertical_velocity)

    def update(self, state: State, dt: float) -> Motors:
        """Return the motor commands for now."""
        if self._motors is not None:
            return self._motors
        if self._in_position:
            target, thrust, yaw_rate = self.position.update(state, dt)
            rates = self.attitude.update(state.orientation, target, yaw_rate)
        else:
            thrust = self._thrust
            rates = (
                self._target_rates
                if self._target is None
                else self.attitude.update(state.orientation, self._target, 0.0)
            )
        roll, pitch, yaw = self.rates.update(state.angular_velocity, rates, dt)
        return self.mixer.mix(thrust, roll, pitch, yaw)

    def _take_over(self) -> None:
        """Switch to position or velocity flight, with a reset of stale loop states."""
        if not self._in_position:
            self.position.reset()
        self._leave_motors()
        self._in_position = True
        self._in_velocity = False

    def _leave_motors(self) -> None:
        """Hand the motors back to the loops, with a reset of stale loop states."""
        if self._motors is not None:
            self._motors = None
            self.rates.reset()

    def _take_thrust(self, thrust: float) -> None:
        self._leave_motors()
        self._thrust = _share(thrust) * self._max_thrust
        self._in_position = self._in_velocity = False


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))


def _clip(value: float, limit: float) -> float:
    return min(limit, max(-limit, value))


Setpoint = (
    ev.PositionSetpoint
    | ev.VelocitySetpoint
    | ev.AttitudeSetpoint
    | ev.BodyRateSetpoint
    | ev.MotorSetpoint
)
"""Set-points accepted by the cascade."""

MOST = 1e6  # in SI units; squares of much greater numbers would overflow in the control loops


def fault(setpoint: Setpoint) -> str | None:
    """Return the error in a set-point, or None."""
    match setpoint:
        case ev.PositionSetpoint():
            numbers = [*setpoint.position, *setpoint.velocity, *setpoint.acceleration]
            numbers += [setpoint.yaw, setpoint.yaw_rate]
        case ev.VelocitySetpoint():
            if setpoint.frame_id not in ("map", "heading"):
                return (
                    "VelocitySetpoint.frame_id: expected 'map' or 'heading', "
                    f"found {setpoint.frame_id!r}"
                )
            numbers = [*setpoint.velocity, setpoint.yaw_rate]
        case ev.AttitudeSetpoint():
            numbers = [setpoint.thrust]
        case ev.BodyRateSetpoint():
            numbers = [*setpoint.angular_velocity, setpoint.thrust]
        case ev.MotorSetpoint():
            numbers = [setpoint.motor1, setpoint.motor2, setpoint.motor3, setpoint.motor4]
    if not all(-MOST <= number <= MOST for number in numbers):
        return f"{type(setpoint).__name__}: expected numbers up to {MOST:g}, found {setpoint}"
    return None
