"""A barometer: the standard atmosphere's pressure at its altitude, drift and noise."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from events import BarometerAnnouncement, FluidPressure
from events.frames import rotate
from runtime.units import Duration
from sims.sensors.sensor import GaussMarkov, NonNegative, Place, Sensor, SensorSpec, Truth

_SEA_LEVEL = 101325.0
_RADIUS = 6378.137
"""Kilometres that AirSim takes for the earth's radius."""


class BarometerSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a barometer; by default those of AirSim's.

    Attributes:
        noise: Standard deviation of the white noise, pascal (AirSim: ``UncorrelatedNoiseSigma``).
            At sea level 12 Pa are a metre.
        drift: Standard deviation of the relative error that drifts (AirSim:
            ``PressureFactorSigma``).
        drift_time: Time constant of the drift (AirSim: ``PressureFactorTau``).
        model: ``gauss_markov``: the drift tends to its standard deviation, of 185 Pa with these
            defaults. ``airsim``: AirSim's recursion, which at 50 Hz tends to 0.3 Pa.
    """

    noise: NonNegative = 2.7
    drift: NonNegative = 0.001825
    drift_time: Duration = Duration(3600)  # immutable
    model: Literal["gauss_markov", "airsim"] = "gauss_markov"


def pressure_at(altitude: float) -> float:
    """Return the pressure (Pa) of the standard atmosphere (ISA) up to 11 km above sea level.

    Args:
        altitude: Geometric altitude, metres.
    """
    return float(_SEA_LEVEL * (288.15 / temperature_at(altitude)) ** -5.255877)


def temperature_at(altitude: float) -> float:
    """Return the temperature (K) of the standard atmosphere up to 11 km above sea level.

    Args:
        altitude: Geometric altitude, metres.
    """
    kilometres = altitude / 1e3
    geopotential = _RADIUS * kilometres / (_RADIUS + kilometres)
    return 288.15 - 6.5 * geopotential


def altitude_at(pressure: float) -> float:
    """Return the pressure altitude (metres) that a barometer with QNH 1013.25 hPa shows."""
    return float((1.0 - (pressure / _SEA_LEVEL) ** 0.190284) * 145366.45 * 0.3048)


class Barometer(Sensor[BarometerSpec]):
    """Pressure at the sensor's place."""

    port = "pressures"
    announced = BarometerAnnouncement

    def __init__(self, spec: BarometerSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        airsim = spec.model == "airsim"
        self._drift = GaussMarkov(spec.drift, spec.drift_time, 1.0 / spec.rate, airsim=airsim)

    def measure(self, truth: Truth) -> FluidPressure:
        """Return the next pressure."""
        spec = self.spec
        down = truth.position[2] + rotate(truth.orientation, spec.position)[2]
        factor = 1.0 + float(self._drift.step(self.random)[0])
        noise = spec.noise * float(self.random.standard_normal())
        return FluidPressure(
            stamp=truth.stamp,
            source=self.source,
            fluid_pressure=pressure_at(self.place.origin[2] - down) * factor + noise,
            variance=spec.noise**2,
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the altitude of the origin."""
        return {"altitude": self.place.origin[2]}
