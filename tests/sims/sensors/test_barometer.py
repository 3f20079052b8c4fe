"""The barometer: the standard atmosphere, noise and drift as its settings say."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sims.sensors.barometer import Barometer, BarometerSpec, altitude_at, pressure_at
from tests.sims.sensors.truths import ORIGIN, PLACE, random, truth


def barometer(seed: int = 0, **settings: Any) -> Barometer:
    return Barometer(BarometerSpec(**settings), PLACE, random(seed))


def errors(sensor: Barometer, count: int) -> npt.NDArray[np.float64]:
    return np.array([sensor.measure(truth()).fluid_pressure for _ in range(count)]) - pressure_at(
        ORIGIN[2]
    )


@pytest.mark.parametrize(
    ("altitude", "pressure"), [(0.0, 101325.0), (122.0, 99867.98), (11019.0, 22632.0)]
)
def test_the_pressure_is_that_of_the_standard_atmosphere(altitude: float, pressure: float) -> None:
    """AirSim's at 122 m; ICAO's at the top of the troposphere, 11 km geopotential."""
    assert pressure_at(altitude) == pytest.approx(pressure, rel=2e-5)


def test_the_altitude_shown_is_airsims() -> None:
    assert altitude_at(pressure_at(122.0)) == pytest.approx(121.947, abs=1e-3)


def test_without_errors_it_measures_the_pressure_of_its_own_place() -> None:
    sensor = barometer(noise=0.0, drift=0.0, position=(0.0, 0.0, 2.0))
    assert sensor.measure(truth((1.0, 2.0, -10.0))).fluid_pressure == pressure_at(
        122.0 + 10.0 - 2.0
    )
    upside_down = truth((1.0, 2.0, -10.0), (0.0, 1.0, 0.0, 0.0))
    assert sensor.measure(upside_down).fluid_pressure == pressure_at(122.0 + 10.0 + 2.0)


def test_the_white_noise_is_the_announced_one() -> None:
    sensor = barometer(drift=0.0)
    assert sensor.announcement().noise == 2.7
    assert errors(sensor, 4000).std() == pytest.approx(2.7, rel=0.05)
    assert sensor.measure(truth()).variance == pytest.approx(2.7**2)


@pytest.mark.slow
def test_the_drift_tends_to_its_standard_deviation_and_airsims_does_not() -> None:
    """With a time constant of 1 s: 0.001825 of the pressure, and √(dt/2τ) = 0.1 of that."""
    base = pressure_at(ORIGIN[2])
    for model, expected in (("gauss_markov", 0.001825), ("airsim", 0.0001825)):
        found = errors(barometer(noise=0.0, drift_time=1.0, model=model), 60_000)[500:]
        assert found.std() / base == pytest.approx(expected, rel=0.1)


def test_the_drift_keeps_its_value_over_its_time_constant() -> None:
    """Autocorrelation e^-1 after one time constant of 0.2 s: ten samples."""
    found = errors(barometer(noise=0.0, drift_time=0.2), 60_000)[500:]
    correlation = float(np.corrcoef(found[:-10], found[10:])[0, 1])
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)


def test_equal_seeds_give_equal_pressures() -> None:
    assert (errors(barometer(1), 50) == errors(barometer(1), 50)).all()
    assert (errors(barometer(1), 50) != errors(barometer(2), 50)).all()
