"""What the server knows of each vehicle, and how it reads where the vehicle is now."""

from __future__ import annotations

from collections.abc import Callable

from events import Vector3
from sims.airsim.structures import Quaternionr, Vector3r
from sims.vehicle import Physics, State


class ServedVehicle:
    """A multirotor of the run as AirSim's methods see it.

    Its local frame has the axes of ``map`` and its origin where ``base_link`` is at the start.

    Args:
        name: The node's.
        physics: Its view of the world's physics.
        now: Gives the run's time (ns).

    Attributes:
        origin: Origin of the local frame in ``map``, metres NED.
        api_control: Whether clients may command it.
        armed: Whether clients have it armed.
    """

    def __init__(self, name: str, physics: Physics, now: Callable[[], int]) -> None:
        self.name = name
        self.physics = physics
        self._now = now
        self.origin: Vector3 = physics.state().position
        self.api_control = False
        self.armed = True

    def state(self) -> State:
        """Return its true state now, in ``map``."""
        self.physics.advance_to(self._now())
        return self.physics.state()

    def local(self, position: Vector3) -> Vector3r:
        """Return a position of ``map`` in the local frame."""
        return Vector3r(*(a - b for a, b in zip(position, self.origin, strict=True)))

    def in_map(self, position: Vector3r) -> Vector3:
        """Return a position of the local frame in ``map``."""
        x, y, z = self.origin
        return position.x_val + x, position.y_val + y, position.z_val + z


def quaternion(orientation: tuple[float, float, float, float]) -> Quaternionr:
    """Return a rotation as AirSim writes it."""
    return Quaternionr(*orientation)
