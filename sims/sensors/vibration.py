"""Vibration of a body by its rotors, as an IMU on it feels it: tones and broad-band noise.

A rotor's force grows with the square of its speed, as its thrust does; so does all that is here.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from events.frames import rotate
from runtime.portable import sines
from sims.sensors.sensor import NonNegative

_BLOCK = 512  # samples per draw
_HOVER = 0.5  # share of the full thrust at which a vehicle about hovers


class Vibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the vibration.

    The tones are those of rotors out of balance, at multiples of their true speeds: in the plane of
    the rotors at odd multiples, along their axis at even ones. Above half of the IMU's rate they
    are seen at another frequency, as with a real IMU without a filter; and so is the noise.

    Attributes:
        amplitude: Of the acceleration of each rotor's first harmonic at full thrust, m/s².
        angular_amplitude: Of the angular velocity there, rad/s.
        rotor_speed: Speed of a rotor at full thrust, revolutions per second.
        harmonics: Strength of each multiple of the speed, relative to `amplitude`.
        density: Density of the acceleration's noise at full thrust, along each axis, m/s²/√Hz: as
            of the IMU's own noise, so that a spectrum of one side shows √2 times as much.
        angular_density: Density of the angular velocity's noise there, rad/s/√Hz.
        corner: Frequency above which the noise declines (first order), Hz; 0: nowhere. It is
            sampled, also by an IMU whose samples are means.
        lower_corner: Frequency below which it declines (second order), Hz; 0: nowhere. What shakes
            goes nowhere, while noise down to 0 Hz adds up to velocities and angles that the body
            does not have.
    """

    amplitude: NonNegative = 0.0
    angular_amplitude: NonNegative = 0.0
    rotor_speed: NonNegative = 130.0
    harmonics: tuple[NonNegative, ...] = (1.0, 0.5)
    density: NonNegative = 0.0
    angular_density: NonNegative = 0.0
    corner: NonNegative = 0.0
    lower_corner: NonNegative = 0.0

    @property
    def shakes(self) -> bool:
        """Whether there is any."""
        return any((self.amplitude, self.angular_amplitude, self.density, self.angular_density))

    def deviation(self, density: float, rate: float) -> float:
        """Return the standard deviation of a sample of noise at full thrust.

        That of an Ornstein-Uhlenbeck process of this density and corner frequency, or of white
        noise at a rate (Hz).
        """
        return density * math.sqrt(math.pi * self.corner if self.corner else rate)

    def announced(self, rate: float) -> float:
        """Return what an IMU of a rate (Hz) announces of it, m/s²; see `events.ImuAnnouncement`."""
        noise = _HOVER * self.deviation(self.density, rate)
        return math.hypot(self.amplitude, noise) if noise else self.amplitude


class VibrationModel:
    """Vibration from sample to sample.

    Args:
        rate: Samples per second.
        averaged: Whether samples are means since the one before.
        from_body: Rotation from the body to the IMU.
        constants: Source of the phases, and of the noise's own generator.
    """

    def __init__(
        self,
        vibration: Vibration,
        rate: float,
        averaged: bool,
        from_body: Quaternion,
        constants: np.random.Generator,
    ) -> None:
        self._vibration = v = vibration
        self._rate, self._averaged, self._from_body = rate, averaged, from_body
        self._phases = constants.uniform(0.0, 2.0 * math.pi, 4)
        self._turns = bool(v.amplitude or v.angular_amplitude)
        deviations = v.deviation(v.angular_density, rate), v.deviation(v.density, rate)
        self._deviations = np.repeat(deviations, 3)
        self._noisy = any(deviations)
        self._noise: list[list[float]] = []
        self._next = 0
        if self._noisy:
            self._generator = np.random.default_rng(constants.integers(2**63))
            self._keep = math.exp(-2.0 * math.pi * v.corner / rate) if v.corner else 0.0
            self._state = self._generator.standard_normal(6)
            self._slow = math.exp(-2.0 * math.pi * v.lower_corner / rate)
            self._means = np.zeros((2, 6))

    def __bool__(self) -> bool:
        return self._turns or self._noisy

    def add(self, rates: Vector3, force: Vector3, thrusts: Any) -> tuple[Vector3, Vector3]:
        """Return angular velocity and specific force with the next sample of the vibration.

        Args:
            thrusts: Of the rotors, 0 to 1 of the greatest.
        """
        share = np.clip(np.asarray(thrusts, dtype=np.float64), 0.0, None)
        if self._turns:
            x, y, z = self._tones(share)
            a, b = self._vibration.angular_amplitude, self._vibration.amplitude
            rates = (rates[0] + a * x, rates[1] + a * y, rates[2] + a * z)
            force = (force[0] + b * x, force[1] + b * y, force[2] + b * z)
        if self._noisy:
            if self._next == len(self._noise):
                self._draw()
            ex, ey, ez, fx, fy, fz = self._noise[self._next]
            self._next += 1
            thrust = sum(share.tolist()) / len(share)
            rates = (rates[0] + thrust * ex, rates[1] + thrust * ey, rates[2] + thrust * ez)
            force = (force[0] + thrust * fx, force[1] + thrust * fy, force[2] + thrust * fz)
        return rates, force

    def _draw(self) -> None:
        """Draw the next samples: those of an Ornstein-Uhlenbeck process, less its drift."""
        news = math.sqrt(1.0 - self._keep**2) * self._generator.standard_normal((_BLOCK, 6))
        for row in news:
            row += self._keep * self._state
            self._state = row.copy()
            if self._vibration.lower_corner:
                for mean in self._means:  # high-pass filters, of gain 1 at half of the rate
                    row -= mean
                    mean += (1.0 - self._slow) * row
                    row *= 0.5 * (1.0 + self._slow)
        self._noise = (news * self._deviations).tolist()
        self._next = 0

    def _tones(self, share: npt.NDArray[np.float64]) -> Vector3:
        vibration = self._vibration
        speeds = vibration.rotor_speed * np.sqrt(share)
        self._phases = (self._phases + 2.0 * math.pi * speeds / self._rate) % (2.0 * math.pi)
        total = np.zeros(3)
        for index, strength in enumerate(vibration.harmonics, start=1):
            weight = strength * share
            if self._averaged:
                turns = np.maximum(math.pi * index * speeds / self._rate, 1e-9)
                weight = weight * sines(turns) / turns
            phases = (index * self._phases).tolist()
            cosine = sum(w * math.cos(phase) for w, phase in zip(weight, phases, strict=True))
            sine = sum(w * math.sin(phase) for w, phase in zip(weight, phases, strict=True))
            total += np.array((cosine, sine, 0.0) if index % 2 else (0.0, 0.0, cosine))
        x, y, z = total.tolist()
        return rotate(self._from_body, (x, y, z))
