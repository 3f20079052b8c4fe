"""The magnetometer: the field of two models at known places, turned, scaled and disturbed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from events.frames import from_rpy
from sims.sensors.magnetometer import Magnetometer, MagnetometerSpec, dipole_field, world_field
from tests.sims.sensors.truths import ORIGIN, PLACE, random, truth


def magnetometer(seed: int = 0, **settings: Any) -> Magnetometer:
    return Magnetometer(MagnetometerSpec(**settings), PLACE, random(seed))


def test_the_dipole_is_airsims() -> None:
    assert np.multiply(dipole_field(ORIGIN), 1e4) == pytest.approx(
        (0.25043, 0.03409, 0.36581), abs=1e-5
    )


@pytest.mark.parametrize(
    ("place", "year", "nanotesla"),
    [
        ((80.0, 0.0, 0.0), 2020.0, (6570.4, -146.3, 54606.0)),  # NCEI's WMM2020 test values
        ((65.0, 85.0, 0.0), 2026.5, (8739.6, 2229.3, 60367.2)),  # package wmm2025, NCEI's C code
    ],
)
def test_the_world_model_gives_what_others_compute(
    place: tuple[float, float, float], year: float, nanotesla: tuple[float, float, float]
) -> None:
    assert np.multiply(world_field(place, year), 1e9) == pytest.approx(nanotesla, abs=0.1)


def test_near_seattle_it_points_15_degrees_east_of_north_and_69_down() -> None:
    north, east, down = magnetometer().field
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(14.9, abs=0.3)
    assert np.degrees(np.arctan2(down, np.hypot(north, east))) == pytest.approx(68.8, abs=0.3)


def test_the_field_is_in_the_sensors_own_axes() -> None:
    """Heading east and mounted upside down: ahead is east, right is north, down is up."""
    sensor = magnetometer(noise=0.0, orientation=(180.0, 0.0, 0.0))
    found = sensor.measure(truth(orientation=from_rpy(0.0, 0.0, np.pi / 2)))
    north, east, down = sensor.field
    assert found.magnetic_field == pytest.approx((east, north, -down), rel=1e-6)


def test_noise_bias_and_scale_are_those_of_its_settings() -> None:
    sensor = magnetometer(scale_factor=2.0)
    found = np.array([sensor.measure(truth()).magnetic_field for _ in range(3000)])
    np.testing.assert_allclose(found.std(axis=0), sensor.announcement().noise, rtol=0.05)
    np.testing.assert_allclose(found.mean(axis=0), np.multiply(sensor.field, 2.0), atol=5e-8)
    biases = [
        np.subtract(s.measure(truth()).magnetic_field, s.field)
        for s in (magnetometer(seed, noise=0.0, bias=1e-6) for seed in range(200))
    ]
    assert np.abs(biases).max() <= 1e-6
    np.testing.assert_allclose(np.std(biases, axis=0), 1e-6 / np.sqrt(3.0), rtol=0.15)
