"""From thrust and torque to four motors, and what is given up when they cannot do it all."""

from __future__ import annotations

import numpy as np

from events import Vector3
from sims.vehicle.model import VehicleParameters


class Mixer:
    """Control allocation for four motors.

    When a motor would leave 0 to 1, yaw is given up first, then thrust; roll and pitch are kept as
    long as any thrust allows them, and beyond that shortened together, keeping their direction.
    Without roll and pitch a multirotor falls over; without yaw it merely looks elsewhere.
    (Compare PX4's "airmode" for roll and pitch, and M. Faessler, D. Falanga, D. Scaramuzza,
    *Thrust mixing, saturation, and body-rate control for accurate aggressive quadrotor flight*,
    RA-L 2017.)

    Raises:
        ValueError: The motors cannot make all four of thrust and torques, or equal thrust from
            all would turn the vehicle.
    """

    def __init__(self, parameters: VehicleParameters) -> None:
        motors = parameters.motors
        # A thrust F along -z at (x, y) has the torque (-y F, x F) in FRD.
        effect = np.array(
            [
                (m.max_thrust, -m.position[1] * m.max_thrust, m.position[0] * m.max_thrust,
                 m.max_torque)
                for m in motors
            ]
        ).T  # fmt: skip
        if np.linalg.matrix_rank(effect) < 4:
            raise ValueError("expected motors that can make thrust, roll, pitch and yaw")
        inverse = np.linalg.inv(effect)
        if not np.allclose(inverse[:, 0], inverse[0, 0], rtol=1e-6):
            raise ValueError("expected motors that do not turn the vehicle at equal thrust")
        self.max_thrust = parameters.max_thrust
        self._thrust = float(inverse[0, 0])
        # One column each, as rows of four floats: motor fractions per newton metre.
        self._roll: list[float] = inverse[:, 1].tolist()
        self._pitch: list[float] = inverse[:, 2].tolist()
        self._yaw: list[float] = inverse[:, 3].tolist()
        self._effect = effect

    def mix(
        self, thrust: float, roll: float, pitch: float, yaw: float
    ) -> tuple[float, float, float, float]:
        """Return the motor commands, each in 0 to 1, that come closest to what is asked.

        Args:
            thrust: Newtons, all motors together.
            roll: Newton metres about the body's x (FRD).
            pitch: Newton metres about y.
            yaw: Newton metres about z.
        """
        a, b, c, d = self._roll
        e, f, g, h = self._pitch
        m0 = a * roll + e * pitch
        m1 = b * roll + f * pitch
        m2 = c * roll + g * pitch
        m3 = d * roll + h * pitch
        low = min(m0, m1, m2, m3)
        high = max(m0, m1, m2, m3)
        if high - low > 1.0:
            scale = 1.0 / (high - low)
            m0 *= scale
            m1 *= scale
            m2 *= scale
            m3 *= scale
            low *= scale
            high *= scale
        base = thrust * self._thrust
        if base > 1.0 - high:
            base = 1.0 - high
        if base < -low:
            base = -low
        m0 += base
        m1 += base
        m2 += base
        m3 += base
        a, b, c, d = self._yaw
        a *= yaw
        b *= yaw
        c *= yaw
        d *= yaw
        n0 = m0 + a
        n1 = m1 + b
        n2 = m2 + c
        n3 = m3 + d
        if min(n0, n1, n2, n3) < 0.0 or max(n0, n1, n2, n3) > 1.0:
            share = min(_room(m0, a), _room(m1, b), _room(m2, c), _room(m3, d))
            n0 = min(1.0, max(0.0, m0 + share * a))
            n1 = min(1.0, max(0.0, m1 + share * b))
            n2 = min(1.0, max(0.0, m2 + share * c))
            n3 = min(1.0, max(0.0, m3 + share * d))
        return n0, n1, n2, n3

    def wrench(self, motors: tuple[float, float, float, float]) -> tuple[float, Vector3]:
        """Return the thrust (N) and torque (N m, FRD) of steady motor commands."""
        thrust, roll, pitch, yaw = (self._effect @ motors).tolist()
        return thrust, (roll, pitch, yaw)


def _room(motor: float, change: float) -> float:
    """Return the share, 0 to 1, of `change` that keeps `motor` within 0 to 1."""
    if change > 0.0:
        room = (1.0 - motor) / change
    elif change < 0.0:
        room = motor / -change
    else:
        return 1.0
    return min(1.0, max(0.0, room))
