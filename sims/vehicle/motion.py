"""What sensors know of the body that carries them, whoever moves it."""

from __future__ import annotations

from typing import Any, Protocol

from events import Vector3
from sims.vehicle.physics import Floats, State


class VehicleMotion(Protocol):
    """Motion of a body with sensors in a world: flown by physics, or along a known path.

    The world's states have the body where it is at their time.
    """

    model: Any  # the compiled world

    @property
    def thrusts(self) -> Any:
        """Thrust of each rotor at present, 0 to 1 of its greatest; zeros without rotors."""

    @property
    def time_ns(self) -> int:
        """Time up to which the world is stepped, ns; no later state is asked for than a step on."""

    @property
    def gravity(self) -> float:
        """Acceleration of free fall, m/s²."""

    def advance_to(self, stamp_ns: int) -> None:
        """Step the world up to a time."""

    def state_at(self, stamp_ns: int) -> tuple[State, Floats, Floats]:
        """Return the body's state, and the world's: shapes (nq,) and (nv,), at the present."""

    def imu(self, stamp_ns: int) -> tuple[Vector3, Vector3]:
        """Return true angular velocity (rad/s) and specific force (m/s²) in the IMU's frame."""

    def keep(self, seconds: float) -> None:
        """Keep the states of the last `seconds` from now on, for `past`."""

    def past(self, stamp_ns: int) -> Floats:
        """Return the world's positions at a kept time, shape (nq,); not to be written to."""
