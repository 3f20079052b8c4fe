"""The satellite receiver: AirSim's by default, and with the errors that it announces."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from events.frames import from_geodetic
from sims.sensors.gnss import Gnss, GnssSpec
from tests.sims.sensors.truths import ORIGIN, PLACE, random, truth


def gnss(seed: int = 0, **settings: Any) -> Gnss:
    return Gnss(GnssSpec(**settings), PLACE, random(seed))


def errors(sensor: Gnss, count: int) -> npt.NDArray[np.float64]:
    fixes = (sensor.measure(truth((10.0, 20.0, -30.0))) for _ in range(count))
    found = [from_geodetic((f.latitude, f.longitude, f.altitude), ORIGIN) for f in fixes]
    return np.array(found) - (10.0, 20.0, -30.0)


def test_by_default_it_tells_the_truth_of_its_antenna() -> None:
    sensor = gnss(position=(0.0, 0.0, -0.1))
    fix = sensor.measure(truth((5.0, -6.0, -7.0), velocity=(1.0, 2.0, 3.0), seconds=10.0))
    found = from_geodetic((fix.latitude, fix.longitude, fix.altitude), ORIGIN)
    assert found == pytest.approx((5.0, -6.0, -7.1), abs=1e-6)
    assert fix.velocity == (1.0, 2.0, 3.0)


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
    found = errors(sensor, 3000)
    np.testing.assert_allclose(found.std(axis=0), [1.5, 1.5, 3.0], rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(found.T), np.eye(3), atol=0.06)
    speeds = [sensor.measure(truth(velocity=(1.0, 0.0, 0.0))).velocity for _ in range(2000)]
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.1, rtol=0.06)


@pytest.mark.slow
def test_the_slow_error_is_slow_and_as_large_as_announced() -> None:
    sensor = gnss(horizontal_drift=2.0, vertical_drift=4.0, drift_time=0.2)
    found = errors(sensor, 20_000)[200:]
    np.testing.assert_allclose(found.std(axis=0), [2.0, 2.0, 4.0], rtol=0.1)
    correlation = [np.corrcoef(found[:-10, i], found[10:, i])[0, 1] for i in range(3)]
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.08)


def test_the_covariance_holds_what_was_added() -> None:
    fix = gnss(horizontal_noise=3.0, horizontal_drift=4.0).measure(truth(seconds=60.0))
    covariance = np.reshape(fix.position_covariance, (3, 3))
    np.testing.assert_allclose(np.diag(covariance), [25.01, 25.01, 0.01], rtol=1e-6)
