"""What happened to a vehicle."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event, Vector3


class Armed(Event):
    """The motors may turn."""

    category: ClassVar[Category] = Category.VEHICLE


class Disarmed(Event):
    """The motors are stopped."""

    category: ClassVar[Category] = Category.VEHICLE


class TakenOff(Event):
    """The vehicle has reached the altitude it was asked to take off to."""

    category: ClassVar[Category] = Category.VEHICLE


class Landed(Event):
    """The vehicle stands on the ground."""

    category: ClassVar[Category] = Category.VEHICLE


class Collision(Event):
    """The vehicle touched something; sent once when the contact begins.

    Attributes:
        other: Name of what it touched.
        position: Point of contact, metres in ``map``.
        normal: Unit vector in ``map``, from the other towards the vehicle.
        speed: Closing speed along the normal, metres per second.
    """

    category: ClassVar[Category] = Category.VEHICLE

    other: str
    position: Vector3
    normal: Vector3
    speed: float
