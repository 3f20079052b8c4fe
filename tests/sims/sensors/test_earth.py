"""The barometer: the standard atmosphere, noise and drift as its settings say.

The magnetometer: the field of two models at known places, turned, scaled and disturbed.

The satellite receiver: AirSim's by default, and with the errors that it announces.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from events import Vector3
from events.frames import from_geodetic, from_rpy, multiply
from runtime.errors import MissingDependencyError
from sims.sensors.sensor import (
    Barometer,
    BarometerSpec,
    Gnss,
    GnssSpec,
    Magnetometer,
    MagnetometerSpec,
    altitude_at,
    dipole_field,
    pressure_at,
    world_field,
)
from tests.sims.sensors.truths import ORIGIN, PLACE, random, truth

VECTORS = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


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
        pressures = errors(barometer(noise=0.0, drift_time=1.0, model=model), 60_000)[500:]
        assert pressures.std() / base == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_the_drift_keeps_its_value_over_its_time_constant() -> None:
    """Autocorrelation e^-1 after one time constant of 0.2 s: ten samples."""
    drift = errors(barometer(noise=0.0, drift_time=0.2), 60_000)[500:]
    correlation = float(np.corrcoef(drift[:-10], drift[10:])[0, 1])
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)


def test_equal_seeds_give_equal_pressures() -> None:
    assert (errors(barometer(1), 50) == errors(barometer(1), 50)).all()
    assert (errors(barometer(1), 50) != errors(barometer(2), 50)).all()


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


def test_the_world_model_names_its_library_if_it_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """AirSim's field needs none."""
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(MissingDependencyError, match=r"pygeomag: pip install -e '\.\[wmm\]'"):
        magnetometer()
    assert magnetometer(model="airsim").field == dipole_field(ORIGIN)


def test_near_seattle_it_points_15_degrees_east_of_north_and_69_down() -> None:
    north, east, down = magnetometer().field
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(14.9, abs=0.3)
    assert np.degrees(np.arctan2(down, np.hypot(north, east))) == pytest.approx(68.8, abs=0.3)


def test_the_field_is_in_the_sensors_own_axes() -> None:
    """Heading east and mounted upside down: ahead is east, right is north, down is up."""
    sensor = magnetometer(noise=0.0, orientation=(180.0, 0.0, 0.0))
    measurement = sensor.measure(truth(orientation=from_rpy(0.0, 0.0, np.pi / 2)))
    north, east, down = sensor.field
    assert measurement.magnetic_field == pytest.approx((east, north, -down), rel=1e-6)


def test_noise_bias_and_scale_are_those_of_its_settings() -> None:
    sensor = magnetometer(scale_factor=2.0)
    fields = np.array([sensor.measure(truth()).magnetic_field for _ in range(3000)])
    np.testing.assert_allclose(fields.std(axis=0), sensor.announcement().noise, rtol=0.05)
    np.testing.assert_allclose(fields.mean(axis=0), np.multiply(sensor.field, 2.0), atol=5e-8)
    biases = [
        np.subtract(s.measure(truth()).magnetic_field, s.field)
        for s in (magnetometer(seed, noise=0.0, bias=1e-6) for seed in range(200))
    ]
    assert np.abs(biases).max() <= 1e-6
    np.testing.assert_allclose(np.std(biases, axis=0), 1e-6 / np.sqrt(3.0), rtol=0.15)


def gnss(seed: int = 0, **settings: Any) -> Gnss:
    return Gnss(GnssSpec(**settings), PLACE, random(seed))


def misplacements(sensor: Gnss, count: int) -> npt.NDArray[np.float64]:
    fixes = (sensor.measure(truth((10.0, 20.0, -30.0))) for _ in range(count))
    positions = [from_geodetic((f.latitude, f.longitude, f.altitude), ORIGIN) for f in fixes]
    return np.array(positions) - (10.0, 20.0, -30.0)


def test_by_default_it_tells_the_truth_of_its_antenna() -> None:
    sensor = gnss(position=(0.0, 0.0, -0.1))
    fix = sensor.measure(truth((5.0, -6.0, -7.0), velocity=(1.0, 2.0, 3.0), seconds=10.0))
    position = from_geodetic((fix.latitude, fix.longitude, fix.altitude), ORIGIN)
    assert position == pytest.approx((5.0, -6.0, -7.1), abs=1e-6)
    assert fix.velocity == (1.0, 2.0, 3.0)


@given(VECTORS, VECTORS, VECTORS, VECTORS)
def test_its_velocity_is_the_rate_of_change_of_its_position(
    angles: Vector3, velocity: Vector3, rates: Vector3, antenna: Vector3
) -> None:
    """On a body that moves and turns evenly, whatever its attitude."""
    sensor, turning = gnss(position=antenna), np.hypot.reduce(rates)

    def fix(seconds: float) -> tuple[Vector3, Vector3]:
        half = 0.5 * turning * seconds
        axis = np.multiply(rates, np.sin(half) / (turning or 1.0)).tolist()
        turn = multiply(from_rpy(*angles), (float(np.cos(half)), *axis))
        place = tuple(np.multiply(velocity, seconds).tolist())
        measurement = sensor.measure(truth(place, turn, velocity, rates))
        where = (measurement.latitude, measurement.longitude, measurement.altitude)
        return from_geodetic(where, ORIGIN), measurement.velocity

    (before, _), (_, said), (after, _) = fix(-1e-3), fix(0.0), fix(1e-3)
    np.testing.assert_allclose(said, np.subtract(after, before) / 2e-3, atol=1e-3)


@given(VECTORS, VECTORS)
@example((-0.0, -0.0, -0.0), (1.0, 2.0, 3.0))
def test_at_the_centre_of_mass_turning_changes_no_bit_of_its_velocity(
    velocity: Vector3, rates: Vector3
) -> None:
    measured = gnss().measure(truth(velocity=velocity, angular_velocity=rates)).velocity
    no_noise = 0.0 * random().standard_normal((2, 3))[1]  # zeros of either sign
    assert np.array(measured).tobytes() == (np.array(velocity) + no_noise).tobytes()


@pytest.mark.parametrize(
    ("seconds", "eph", "status"),
    [(0.0, 100.0, -1), (3.1, 3.29, -1), (3.2, 2.95, 0), (30.0, 0.1, 0)],
)
def test_its_uncertainty_sinks_as_airsims(seconds: float, eph: float, status: int) -> None:
    """A fix after 3.2 s."""
    fix = gnss().measure(truth(seconds=seconds))
    assert np.sqrt(np.diag(np.reshape(fix.position_covariance, (3, 3)))) == pytest.approx(
        [eph] * 3, rel=0.01
    )
    assert fix.status == status


def test_white_noise_is_the_announced_one() -> None:
    sensor = gnss(horizontal_noise=1.5, vertical_noise=3.0, velocity_noise=0.1)
    announced = sensor.announcement()
    assert (announced.horizontal_noise, announced.vertical_noise) == (1.5, 3.0)
    offsets = misplacements(sensor, 3000)
    np.testing.assert_allclose(offsets.std(axis=0), [1.5, 1.5, 3.0], rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(offsets.T), np.eye(3), atol=0.06)
    speeds = [sensor.measure(truth(velocity=(1.0, 0.0, 0.0))).velocity for _ in range(2000)]
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.1, rtol=0.06)


@pytest.mark.slow
def test_the_slow_error_is_slow_and_as_large_as_announced() -> None:
    sensor = gnss(horizontal_drift=2.0, vertical_drift=4.0, drift_time=0.2)
    offsets = misplacements(sensor, 20_000)[200:]
    np.testing.assert_allclose(offsets.std(axis=0), [2.0, 2.0, 4.0], rtol=0.1)
    correlation = [np.corrcoef(offsets[:-10, i], offsets[10:, i])[0, 1] for i in range(3)]
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.08)


def test_the_covariance_holds_what_was_added() -> None:
    fix = gnss(horizontal_noise=3.0, horizontal_drift=4.0).measure(truth(seconds=60.0))
    covariance = np.reshape(fix.position_covariance, (3, 3))
    np.testing.assert_allclose(np.diag(covariance), [25.01, 25.01, 0.01], rtol=1e-6)
