"""Vibration by the rotors: its tones' and its noise's strength, spectrum and beginning."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sims.presets import IMUS
from sims.sensors.imu import ImuModel, ImuParameters
from sims.sensors.sensor import Place
from sims.sensors.vibration import Vibration, VibrationModel

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)
PLACE = Place("drone/imu", "base_link", (47.0, 8.0, 400.0))
HOVER = 0.453  # thrust of the simulated multirotor


def samples(vibration: Vibration, rate: float, thrust: float, seconds: float) -> np.ndarray:
    """Return angular velocity and acceleration by the vibration alone, shape (n, 6)."""
    model = VibrationModel(vibration, rate, False, UPRIGHT, np.random.default_rng(4))
    rows = [model.add(ZERO, ZERO, [thrust] * 4) for _ in range(round(rate * seconds))]
    return np.array(rows).reshape(-1, 6)


def spectrum(rows: np.ndarray, rate: float, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (Hz) and the power spectral density of each column."""
    from scipy.signal import welch  # half a second, which one process of the tests has to pay

    frequencies, power = welch(rows, rate, nperseg=length, axis=0)
    return frequencies, power


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("corner", [0.0, 30.0])
def test_the_noise_has_the_stated_density_at_any_rate(rate: float, corner: float) -> None:
    vibration = Vibration(density=0.1, angular_density=2e-3, corner=corner)
    rows = samples(vibration, rate, 0.5, 12_000.0 / rate)
    for columns, density in ((rows[:, 3:], 0.1), (rows[:, :3], 2e-3)):
        frequencies, power = spectrum(columns, rate, 512)
        low = (frequencies > 2.0) & (frequencies < (8.0 if corner else rate / 2))
        assert math.sqrt(power[low].mean() / 2) == pytest.approx(0.5 * density, rel=0.1)
    if corner and rate > 500.0:
        ratio = power[(frequencies > 85) & (frequencies < 95)].mean() / power[low].mean()
        assert ratio == pytest.approx(1 / (1 + (90 / corner) ** 2), rel=0.25)


def test_the_noise_has_its_deviation_from_the_first_sample_on() -> None:
    vibration = Vibration(density=0.1, corner=5.0)
    first = np.array(
        [
            VibrationModel(vibration, 200.0, False, UPRIGHT, np.random.default_rng(seed)).add(
                ZERO, ZERO, [1.0] * 4
            )[1]
            for seed in range(150)
        ]
    )
    assert first.std() == pytest.approx(0.1 * math.sqrt(math.pi * 5.0), rel=0.1)
    assert vibration.deviation(0.1, 200.0) == pytest.approx(0.1 * math.sqrt(math.pi * 5.0))


def test_what_shakes_goes_nowhere() -> None:
    """Against the same noise down to 0 Hz, and against its stated share at two frequencies."""
    open_, bound = (
        samples(Vibration(density=0.1, lower_corner=lower), 200.0, 1.0, 60.0)
        for lower in (0.0, 10.0)
    )
    fast, slow = (np.abs(rows[:, 3:].sum(axis=0) / 200.0).mean() for rows in (open_, bound))
    assert slow < 0.02 < 0.3 < fast  # velocities, m/s
    frequencies, power = spectrum(bound[:, 3:], 200.0, 512)
    for frequency in (5.0, 20.0):
        near = np.abs(frequencies - frequency) < 1.0
        ratio = (frequency / 10.0) ** 2
        expected = 2 * 0.1**2 * (ratio / (1.0 + ratio)) ** 2
        assert power[near].mean() == pytest.approx(expected, rel=0.25)


def test_nothing_shakes_at_rest_and_noise_grows_with_thrust() -> None:
    vibration = Vibration(amplitude=1.0, density=0.1, angular_density=1e-3, corner=50.0)
    assert not samples(vibration, 200.0, 0.0, 0.5).any()
    half, full = (samples(Vibration(density=0.1), 200.0, share, 20.0).std() for share in (0.5, 1.0))
    assert full == pytest.approx(2.0 * half)


def test_noise_does_not_change_the_tones() -> None:
    tones = samples(Vibration(amplitude=1.0), 200.0, 0.5, 1.0)
    both = samples(Vibration(amplitude=1.0, density=1e-9), 200.0, 0.5, 1.0)
    assert np.allclose(tones, both, atol=1e-6)


def test_what_is_announced_has_the_noise_in_it_and_is_the_amplitude_without() -> None:
    assert Vibration(amplitude=1.5).announced(200.0) == 1.5
    white = Vibration(amplitude=3.0, density=0.4 / math.sqrt(2.0))
    assert white.announced(800.0) == pytest.approx(5.0)


def test_the_flight_preset_shakes_as_the_imu_of_euroc_in_flight() -> None:
    parameters = ImuParameters(**IMUS["adis16448_flight"] | {"vibration": Vibration(
        **IMUS["adis16448_flight"]["vibration"]
    )})  # fmt: skip
    model = ImuModel(parameters, 200.0, np.random.default_rng(1), np.random.default_rng(2), PLACE)
    rows = np.array(
        [model.measure(ZERO, (0.0, 0.0, -9.81), [HOVER] * 4) for _ in range(6_000)]
    ).reshape(-1, 6)
    frequencies, power = spectrum(rows - rows.mean(axis=0), 200.0, 1024)
    high = frequencies > 20.0
    width = frequencies[1]
    deviations = np.sqrt(power[high].sum(axis=0) * width)
    assert (deviations[3:] > 0.5).all()
    assert (deviations[3:] < 1.0).all()
    assert (deviations[:3] > 0.022).all()
    assert (deviations[:3] < 0.038).all()
    floor = np.sqrt(np.median(power[high], axis=0))
    assert (floor[3:] > 0.044).all()
    assert (floor[3:] < 0.088).all()
    assert frequencies[power[:, 3].argmax()] == pytest.approx(91.0, abs=2.0)
    slow = np.sqrt(power[frequencies < 5.0].sum(axis=0) * width)
    assert (slow[3:] < 0.05).all()
    assert (slow[:3] < 6.5e-4).all()


def test_a_bias_that_comes_and_goes_has_its_deviation_and_an_ideal_imu_has_none() -> None:
    def bias(**settings: Any) -> np.ndarray:
        silent: dict[str, Any] = dict.fromkeys(
            ("gyroscope_noise_density", "gyroscope_random_walk",
             "accelerometer_noise_density", "accelerometer_random_walk"), 0.0
        )  # fmt: skip
        parameters = ImuParameters(
            **silent | {"accelerometer_bias_instability": 0.02, "bias_instability_time": 0.5}
            | settings
        )  # fmt: skip
        model = ImuModel(
            parameters, 200.0, np.random.default_rng(1), np.random.default_rng(2), PLACE
        )
        return np.array([model.measure(ZERO, ZERO, [0.0] * 4) for _ in range(10_000)])

    rates, forces = bias().swapaxes(0, 1)
    assert not rates.any()
    assert forces.std() == pytest.approx(0.02, rel=0.15)
    near, far = (
        np.mean(forces[:-lag] * forces[lag:]) / forces.var() for lag in (20, 100)
    )  # 0.1 s and 0.5 s
    assert near == pytest.approx(math.exp(-0.2), abs=0.08)
    assert far == pytest.approx(math.exp(-1.0), abs=0.15)
    assert not bias(ideal=True).any()


def test_an_instability_without_a_time_is_refused() -> None:
    with pytest.raises(ValueError, match="bias_instability_time: expected more than 0 s"):
        ImuParameters(gyroscope_bias_instability=1e-4, bias_instability_time=0.0)  # type: ignore[arg-type]
