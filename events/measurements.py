"""What the small sensors measure: which fields of their events are numbers, and in which unit."""

from __future__ import annotations

from events import Event, FluidPressure, Imu, MagneticField, NavSatFix, Range, Wind

MEASURED: dict[type[Event], dict[str, str]] = {
    Imu: {"angular_velocity": "rad/s", "linear_acceleration": "m/s²"},
    FluidPressure: {"fluid_pressure": "Pa"},
    MagneticField: {"magnetic_field": "T"},
    NavSatFix: {"latitude": "°", "longitude": "°", "altitude": "m", "velocity": "m/s"},
    Range: {"range": "m"},
    Wind: {"velocity": "m/s"},
}
"""Fields and their units, by type of event; the field of a vector has x, y and z."""


def fields_of(kind: type[Event]) -> dict[str, str]:
    """Return what events of a type measure, with units; nothing if it is no such type."""
    return next((fields for known, fields in MEASURED.items() if issubclass(kind, known)), {})


def numbers(event: Event, field: str) -> tuple[float, ...]:
    """Return what an event measures in a field: one number, or x, y and z."""
    value = getattr(event, field)
    return value if isinstance(value, tuple) else (value,)
