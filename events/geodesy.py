"""Places on the earth: between ``map`` (NED at an origin) and WGS 84's latitude and longitude.

Through earth-centred, earth-fixed coordinates (ECEF), so without approximation: a run's ``map`` is
the plane that touches the ellipsoid's parallel surface at the origin.
"""

from __future__ import annotations

import functools
from math import atan2, cos, degrees, hypot, radians, sin, sqrt

from events.base import Vector3

Geodetic = tuple[float, float, float]
"""Latitude and longitude, degrees north and east, and metres above the WGS 84 ellipsoid."""

SEMI_MAJOR = 6378137.0
"""Metres (NIMA TR8350.2, table 3.1)."""

FLATTENING = 1.0 / 298.257223563

_E2 = FLATTENING * (2.0 - FLATTENING)


def to_ecef(place: Geodetic) -> Vector3:
    """Return earth-centred, earth-fixed coordinates, metres."""
    latitude, longitude = radians(place[0]), radians(place[1])
    normal = SEMI_MAJOR / sqrt(1.0 - _E2 * sin(latitude) ** 2)
    across = (normal + place[2]) * cos(latitude)
    up = (normal * (1.0 - _E2) + place[2]) * sin(latitude)
    return (across * cos(longitude), across * sin(longitude), up)


def from_ecef(point: Vector3) -> Geodetic:
    """Return a place by its earth-centred coordinates (metres), to a micrometre below 1000 km.

    B. R. Bowring, "Transformation from spatial to geographical coordinates", 1976, two rounds.
    """
    x, y, z = point
    across = hypot(x, y)
    reduced = atan2(z, (1.0 - FLATTENING) * across)
    for _ in range(2):
        latitude = atan2(
            z + _E2 / (1.0 - FLATTENING) * SEMI_MAJOR * sin(reduced) ** 3,
            across - _E2 * SEMI_MAJOR * cos(reduced) ** 3,
        )
        reduced = atan2((1.0 - FLATTENING) * sin(latitude), cos(latitude))
    normal = SEMI_MAJOR / sqrt(1.0 - _E2 * sin(latitude) ** 2)
    height = across * cos(latitude) + z * sin(latitude) - SEMI_MAJOR**2 / normal
    return (degrees(latitude), degrees(atan2(y, x)), height)


def to_geodetic(position: Vector3, origin: Geodetic) -> Geodetic:
    """Return where a position in ``map`` (metres NED) is, for an origin of ``map``."""
    (north, east, down), start = _frame(origin)
    n, e, d = position
    x, y, z = (
        begin + (n * along + e * across + d * below)
        for begin, along, across, below in zip(start, north, east, down, strict=True)
    )
    return from_ecef((x, y, z))


def from_geodetic(place: Geodetic, origin: Geodetic) -> Vector3:
    """Return a place's position in ``map``, metres NED, for an origin of ``map``."""
    apart = [a - b for a, b in zip(to_ecef(place), to_ecef(origin), strict=True)]
    x, y, z = (sum(a * b for a, b in zip(axis, apart, strict=True)) for axis in _axes(origin))
    return (x, y, z)


@functools.lru_cache(maxsize=16)
def _frame(origin: Geodetic) -> tuple[tuple[Vector3, Vector3, Vector3], Vector3]:
    """Return the axes at an origin, and its own place."""
    return _axes(origin), to_ecef(origin)


def _axes(origin: Geodetic) -> tuple[Vector3, Vector3, Vector3]:
    """Return the unit vectors north, east and down at a place, in ECEF."""
    latitude, longitude = radians(origin[0]), radians(origin[1])
    sp, cp, sl, cl = sin(latitude), cos(latitude), sin(longitude), cos(longitude)
    return (-sp * cl, -sp * sl, cp), (-sl, cl, 0.0), (-cp * cl, -cp * sl, -sp)
