"""A magnetometer: the earth's field at the origin, in the sensor's axes."""

from __future__ import annotations

from math import acos, asin, atan, cos, radians, sin, sqrt, tan
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from events import MagneticField, MagnetometerAnnouncement, Vector3
from events.frames import multiply, rotate_inverse
from sims.sensors.sensor import NonNegative, Place, Positive, Sensor, SensorSpec, Truth

Geodetic = tuple[float, float, float]


class MagnetometerSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a magnetometer; by default the noise of AirSim's in the World Magnetic Model.

    Attributes:
        noise: Standard deviation of the white noise of each axis, tesla (AirSim: ``NoiseSigma``,
            in gauss, which are 1e-4 tesla).
        bias: Greatest bias of each axis, tesla, drawn once and evenly (AirSim: ``NoiseBias``).
        scale_factor: Factor on the field (AirSim: ``ScaleFactor``).
        model: ``wmm``: the World Magnetic Model. ``airsim``: AirSim's dipole, which near Seattle is
            off by 7 degrees in declination and 13 in inclination.
        year: Date of the World Magnetic Model: 2026.5 is the middle of 2026.
    """

    noise: NonNegative = 5e-7
    bias: NonNegative = 0.0
    scale_factor: Positive = 1.0
    model: Literal["wmm", "airsim"] = "wmm"
    year: Annotated[float, msgspec.Meta(ge=2010.0, le=2030.0)] = 2026.0


def world_field(place: Geodetic, year: float) -> Vector3:
    """Return the field of the World Magnetic Model (NCEI and BGS) at a place, tesla NED."""
    from pygeomag import GeoMag  # a tenth of a second that only magnetometers need

    five_years = min(5 * int(year // 5), 2025)
    latitude, longitude, altitude = place
    field = GeoMag(base_year=five_years).calculate(latitude, longitude, altitude / 1e3, year)
    return (field.x * 1e-9, field.y * 1e-9, field.z * 1e-9)


def dipole_field(place: Geodetic) -> Vector3:
    """Return AirSim's field at a place, tesla NED: a dipole whose pole is at 80.31° N, 72.62° W.

    AirSim's ``EarthUtils::getMagField``, with latitudes in the place of colatitudes as there.
    """
    latitude, longitude, altitude = radians(place[0]), radians(place[1]), place[2]
    pole, meridian = radians(80.31), radians(-72.62)
    turn = longitude - meridian
    cosine = cos(latitude) * cos(pole) + sin(latitude) * sin(pole) * cos(turn)
    colatitude = acos(cosine)
    radius = 6378137.0
    strength = 3.12e-5 * (radius / (radius + altitude)) ** 3 * sqrt(1.0 + 3.0 * cosine**2)
    dip = atan(2.0 / tan(colatitude))
    side = sin(turn) if cosine > sin(pole) * sin(latitude) else cos(turn)
    declination = asin(side * cos(pole) / sin(colatitude))
    level = strength * cos(dip)
    return (level * cos(declination), level * sin(declination), strength * sin(dip))


class Magnetometer(Sensor[MagnetometerSpec]):
    """The field at the origin, the same in the whole world."""

    port = "magnetic_fields"
    announced = MagnetometerAnnouncement

    def __init__(self, spec: MagnetometerSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        airsim = spec.model == "airsim"
        self.field = dipole_field(place.origin) if airsim else world_field(place.origin, spec.year)
        """Tesla NED."""
        self._bias = random.uniform(-1.0, 1.0, 3) * spec.bias

    def measure(self, truth: Truth) -> MagneticField:
        """Return the next field."""
        spec = self.spec
        true = rotate_inverse(multiply(truth.orientation, spec.rotation), self.field)
        noise = spec.noise * self.random.standard_normal(3)
        x, y, z = (np.multiply(true, spec.scale_factor) + noise + self._bias).tolist()
        return MagneticField(
            stamp=truth.stamp, source=self.source, frame_id=self.source, magnetic_field=(x, y, z)
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the field."""
        return {"field": self.field}
