"""A satellite receiver: geodetic position and velocity, with noise, drift and a late first fix."""

from __future__ import annotations

from math import exp
from typing import Any

import numpy as np

from events import NavSatAnnouncement, NavSatFix
from events.frames import rotate, to_geodetic
from runtime.units import Duration, Latency
from sims.sensors.sensor import GaussMarkov, NonNegative, Place, Positive, Sensor, SensorSpec, Truth


class GnssSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a satellite receiver; by default those of AirSim's GPS, which is free of errors.

    Attributes:
        horizontal_noise: Standard deviation of the white noise, north and east, metres.
        vertical_noise: Standard deviation of the white noise, down, metres.
        horizontal_drift: Standard deviation of the slow error, north and east, metres.
        vertical_drift: Standard deviation of the slow error, down, metres.
        drift_time: Time constant of the slow error, a first-order Gauss-Markov process.
        velocity_noise: Standard deviation of the velocity's white noise, metres per second.
        eph_initial: Uncertainty that the receiver shows at the start, metres (AirSim:
            ``EphInitial`` and ``EpvInitial``). It is part of `position_covariance`, and of nothing
            else: the position itself is as good at the start as later.
        eph_final: What the uncertainty sinks to, metres (AirSim: ``EphFinal``, ``EpvFinal``).
        eph_time_constant: Time constant with which it sinks (AirSim: ``EPH_TimeConstant``).
        eph_min_3d: Uncertainty, metres, from which on a fix has status 0 (AirSim: ``EphMin3d``).
    """

    latency: Latency = Latency(0.2)  # immutable
    startup_delay: Latency = Latency(1.0)
    horizontal_noise: NonNegative = 0.0
    vertical_noise: NonNegative = 0.0
    horizontal_drift: NonNegative = 0.0
    vertical_drift: NonNegative = 0.0
    drift_time: Duration = Duration(60.0)
    velocity_noise: NonNegative = 0.0
    eph_initial: NonNegative = 100.0
    eph_final: NonNegative = 0.1
    eph_time_constant: Duration = Duration(0.9)
    eph_min_3d: Positive = 3.0


class Gnss(Sensor[GnssSpec]):
    """Position and velocity of the antenna."""

    port = "fixes"
    announced = NavSatAnnouncement

    def __init__(self, spec: GnssSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        self._drift = GaussMarkov(1.0, spec.drift_time, 1.0 / spec.rate, 3)
        self._noises = np.array([spec.horizontal_noise] * 2 + [spec.vertical_noise])
        self._drifts = np.array([spec.horizontal_drift] * 2 + [spec.vertical_drift])

    def measure(self, truth: Truth) -> NavSatFix:
        """Return the next fix."""
        spec = self.spec
        numbers = self.random.standard_normal((2, 3))
        error = self._noises * numbers[0] + self._drifts * self._drift.step(self.random)
        lever = rotate(truth.orientation, spec.position)
        north, east, down = (np.add(truth.position, lever) + error).tolist()
        latitude, longitude, altitude = to_geodetic((north, east, down), self.place.origin)
        vx, vy, vz = (np.array(truth.velocity) + spec.velocity_noise * numbers[1]).tolist()
        shown = self._uncertainty(truth.stamp / 1e9)
        covariance = np.diag(shown**2 + self._noises**2 + self._drifts**2)
        return NavSatFix(
            stamp=truth.stamp,
            source=self.source,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=tuple(covariance.ravel().tolist()),
            velocity=(vx, vy, vz),
            status=0 if shown <= spec.eph_min_3d else -1,
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the place of the origin."""
        return dict(zip(("latitude", "longitude", "altitude"), self.place.origin, strict=True))

    def _uncertainty(self, seconds: float) -> float:
        """Return AirSim's eph (and epv): a first-order lag."""
        spec = self.spec
        if not spec.eph_time_constant:
            return spec.eph_final
        left = exp(-seconds / spec.eph_time_constant)
        return spec.eph_final + (spec.eph_initial - spec.eph_final) * left
