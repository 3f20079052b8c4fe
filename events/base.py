"""What every event is: frozen data with a time, a source and a category."""

from __future__ import annotations

import enum
from typing import Any, ClassVar, dataclass_transform

import msgspec

Vector3 = tuple[float, float, float]
"""x, y, z. Unit and frame stand beside each field that uses it."""

Quaternion = tuple[float, float, float, float]
"""Unit quaternion **w, x, y, z** (Hamilton); rotates child-frame vectors into the parent frame."""


class Category(enum.Flag):
    """What an event is about; for filtering and logging, never for routing."""

    LIFECYCLE = enum.auto()
    WINDOW = enum.auto()
    INPUT = enum.auto()
    GEOMETRY = enum.auto()
    SENSOR = enum.auto()
    CONTROL = enum.auto()
    VEHICLE = enum.auto()
    ESTIMATE = enum.auto()
    MAP = enum.auto()
    SCORE = enum.auto()
    ANNOUNCEMENT = enum.auto()
    USER = enum.auto()


class EventMeta(msgspec.StructMeta):
    """Makes every subclass of `Event` frozen and keyword-only without its having to say so."""

    def __new__(
        cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any
    ) -> EventMeta:
        """Create the class; msgspec inherits neither option to subclasses in the way we need."""
        options = {"frozen": True, "kw_only": True, "gc": False} | options
        return super().__new__(cls, name, bases, namespace, **options)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(msgspec.field,))
class Event(msgspec.Struct, metaclass=EventMeta, frozen=True, kw_only=True):
    """Something that a node sends to all that listen.

    Subclass it to add fields; every subclass is frozen and takes keyword arguments only.

    Attributes:
        stamp: Nanoseconds on the run's clock at which what the event describes was true
            (the exposure of an image, not its arrival). An `int`: no bool, float or numpy number.
        source: Who sends it, as a path: ``drone``, ``drone/front_center``.
    """

    category: ClassVar[Category] = Category.USER

    stamp: int
    source: str
