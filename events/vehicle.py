"""What happened to a vehicle."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event, Vector3
from events.checks import check


class VehicleEvent(Event):
    """Base of all that can happen to a vehicle."""

    category: ClassVar[Category] = Category.VEHICLE

    def __post_init__(self) -> None:
        check(self)


class Armed(VehicleEvent):
    """The motors may turn."""


class Disarmed(VehicleEvent):
    """The motors are stopped."""


class TakenOff(VehicleEvent):
    """The vehicle has reached the altitude it was asked to take off to."""


class Landed(VehicleEvent):
    """The vehicle stands on the ground."""


class Collision(VehicleEvent):
    """The vehicle touched something; sent once when the contact begins.

    Attributes:
        other: Name of what it touched.
        position: Point of contact, metres in ``map``.
        normal: Unit vector in ``map``, from the other towards the vehicle.
        speed: Closing speed along the normal, metres per second.
    """

    other: str
    position: Vector3
    normal: Vector3
    speed: float

    def __post_init__(self) -> None:
        check(self, self.position, self.normal, (self.speed, 0.0, 0.0))
