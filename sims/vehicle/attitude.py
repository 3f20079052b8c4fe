"""The inner loops: attitude to body rates, and body rates to torque.

All floats, at the rate of the caller; where the vehicle should point is decided in `position`.
"""

from __future__ import annotations

from math import atan2, pi, sqrt

from events import Quaternion, Vector3
from sims.vehicle.gains import Gains, Limits
from sims.vehicle.model import VehicleParameters


class AttitudeController:
    """Quaternion attitude control that puts tilt before yaw.

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
        """Return the body rates (rad/s, FRD) that turn `orientation` to `target`.

        Args:
            orientation: Rotation FRD → NED.
            target: Rotation FRD → NED.
            yaw_rate: Feed-forward, rad/s about the world's z (down).
        """
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

    _INTEGRAL = 10.0
    """Most that an integrator adds, rad/s²."""

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
        """Return the torque (N m, FRD) that brings `rates` to `target` (both rad/s, FRD)."""
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
