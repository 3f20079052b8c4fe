"""Noise of an IMU: white noise and a bias that is a random walk. True values are in `physics`."""

from __future__ import annotations

from math import sqrt

import msgspec
import numpy as np

from events import Vector3

_BLOCK = 512
"""Samples drawn at once: numpy's cost per call is that of a few hundred random numbers."""


class ImuParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise of an IMU, named as in `events.ImuAnnouncement`; by default that of a usual MEMS.

    Attributes:
        gyroscope_noise_density: White noise of the angular velocity, rad/s/√Hz.
        gyroscope_random_walk: Random walk of its bias, rad/s²/√Hz.
        accelerometer_noise_density: White noise of the acceleration, m/s²/√Hz.
        accelerometer_random_walk: Random walk of its bias, m/s³/√Hz.
    """

    gyroscope_noise_density: float = 1.7e-4
    gyroscope_random_walk: float = 2e-5
    accelerometer_noise_density: float = 2e-3
    accelerometer_random_walk: float = 3e-3


class ImuNoise:
    """Adds noise to true samples taken at a fixed rate.

    The continuous model, truth + bias + white noise with the bias a random walk from zero, sampled
    at intervals dt: standard deviation density/√dt for the noise and random_walk·√dt for each
    step of the bias (J. Crassidis, *Sigma-point Kalman filtering for integrated GPS and inertial
    navigation*, 2006; the same as Kalibr's "IMU noise model").

    Args:
        parameters: Parameters of the noise.
        rate: Samples per second.
        generator: Source of the random numbers; equal seeds give equal noise.

    Raises:
        ValueError: The rate is not positive, or a parameter is negative.
    """

    def __init__(
        self, parameters: ImuParameters, rate: float, generator: np.random.Generator
    ) -> None:
        if not rate > 0.0:
            raise ValueError(f"rate: expected a number > 0, found {rate}")
        for field, value in msgspec.structs.asdict(parameters).items():
            if not value >= 0.0:
                raise ValueError(f"{field}: expected a number >= 0, found {value}")
        root = sqrt(1.0 / rate)
        self._white = np.repeat(
            [
                parameters.gyroscope_noise_density / root,
                parameters.accelerometer_noise_density / root,
            ],
            3,
        )
        self._step = np.repeat(
            [
                parameters.gyroscope_random_walk * root,
                parameters.accelerometer_random_walk * root,
            ],
            3,
        )
        self._generator = generator
        self._bias = np.zeros(6)
        self._errors: list[list[float]] = []
        self._next = 0

    def add(self, angular_velocity: Vector3, specific_force: Vector3) -> tuple[Vector3, Vector3]:
        """Return what the IMU measures at its next sample.

        Args:
            angular_velocity: True, rad/s.
            specific_force: True, m/s², in the same frame.
        """
        if self._next == len(self._errors):
            self._draw()
        ex, ey, ez, fx, fy, fz = self._errors[self._next]
        self._next += 1
        wx, wy, wz = angular_velocity
        ax, ay, az = specific_force
        return (wx + ex, wy + ey, wz + ez), (ax + fx, ay + fy, az + fz)

    def _draw(self) -> None:
        numbers = self._generator.standard_normal((_BLOCK, 12))
        bias = self._bias + np.cumsum(numbers[:, 6:] * self._step, axis=0)
        self._bias = bias[-1]
        self._errors = (numbers[:, :6] * self._white + bias).tolist()
        self._next = 0
