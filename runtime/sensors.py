"""Kinds of sensors known to nodes: the table of `events`, and those of installed packages.

A package's sensor is a class derived from `sims.sensors.sensor.Sensor`, under an entry point of the
group ``visnav.sensors``. It is a table of every vehicle's settings then, and its measurements are
sent, plotted, exported and published like those of the sensors that come with the project.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from events import Event, Wind
from events.sensors import SENSOR_KINDS, SensorKind
from runtime.errors import CommandError
from runtime.extras import SENSORS, others


@cache
def other_sensors() -> tuple[Any, ...]:
    """Import and return the classes of other packages' sensors.

    Raises:
        CommandError: One cannot be imported, is no sensor, or has the name, the events or the group
            of another; the message names the package.
    """
    names = {(what, getattr(k, what)) for k in SENSOR_KINDS.values() for what in _UNIQUE}
    sensors = []
    for offer in others(SENSORS):
        sensor = offer.load()
        whose = f"{offer.name} of the package {offer.package}"
        kind = getattr(sensor, "kind", None)
        if not isinstance(sensor, type) or not isinstance(kind, SensorKind):
            raise CommandError(
                f"{whose}: expected a class derived from sims.sensors.sensor.Sensor, with a "
                f"SensorKind as its kind, found {sensor!r}"
            )
        for what in _UNIQUE:
            if (pair := (what, getattr(kind, what))) in names:
                raise CommandError(
                    f"{whose}: kind.{what}: expected one of its own, found {pair[1]!r}, which "
                    "another sensor has"
                )
            names.add(pair)
        sensors.append(sensor)
    return tuple(sensors)


_UNIQUE = ("name", "event", "group")


def sensor_kinds() -> tuple[SensorKind, ...]:
    """Return the kinds of sensors: the project's, then those of other packages."""
    return (*SENSOR_KINDS.values(), *(sensor.kind for sensor in other_sensors()))


@cache
def measured() -> dict[type[Event], dict[str, str]]:
    """Return the measured fields with their units, by type of event; a vector has x, y and z."""
    fields = {kind.event: kind.fields for kind in sensor_kinds() if kind.fields}
    return {**fields, Wind: {"velocity": "m/s"}}


@cache
def fields_of(event: type[Event]) -> dict[str, str]:
    """Return the measured fields of an event type with their units; empty for other types."""
    return next((fields for known, fields in measured().items() if issubclass(event, known)), {})
