"""Bandwidth of a sensor: what the filter does to motion, and to an IMU that has one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sims.multirotor import MultirotorConfig
from sims.sensors.bandwidth import LowPass
from sims.sensors.imu import NOISES, ImuModel, ImuParameters
from tests.sims.sensors.truths import PLACE

FORCE = (0.0, 0.0, -9.81)


@given(share=st.floats(0.01, 0.49), rate=st.sampled_from([50.0, 200.0, 1000.0]))
def test_the_filter_is_butterworths_of_second_order(share: float, rate: float) -> None:
    low_pass = LowPass(share * rate, rate)
    low_pass((0.0, 0.0, 0.0))
    steps = np.array([low_pass((1.0, 2.0, -3.0)) for _ in range(40)])
    from scipy.signal import butter, lfilter  # half a second, which few tests have to pay

    expected = lfilter(*butter(2, share * rate, fs=rate), np.r_[0.0, np.ones(40)])[1:]
    np.testing.assert_allclose(steps, expected[:, None] * (1.0, 2.0, -3.0), atol=1e-9)


def test_nothing_changes_before_the_first_sample() -> None:
    low_pass = LowPass(20.0, 200.0)
    assert [low_pass(FORCE) for _ in range(3)] == [pytest.approx(FORCE)] * 3


def imu(**settings: Any) -> ImuModel:
    silent = dict.fromkeys(NOISES, 0.0)
    parameters = ImuParameters(**silent | settings)
    return ImuModel(parameters, 400.0, np.random.default_rng(1), np.random.default_rng(2), PLACE)


@pytest.mark.parametrize("sensor", ["gyroscope", "accelerometer"])
def test_each_sensor_has_its_own_bandwidth_and_delay(sensor: str) -> None:
    model = imu(**{f"{sensor}_bandwidth": 40.0})
    times = np.arange(800) / 400.0
    slow = np.sin(2.0 * math.pi * times)  # 1 Hz
    rows = [model.measure((s, 0.0, 0.0), (s, 0.0, 0.0), [0.5] * 4) for s in slow.tolist()]
    gyroscope, accelerometer = np.array(rows)[:, :, 0].T
    late, prompt = gyroscope, accelerometer
    if sensor == "accelerometer":
        late, prompt = prompt, late
    np.testing.assert_allclose(prompt, slow, atol=1e-12)
    delayed = np.sin(2.0 * math.pi * (times - 0.225 / 40.0))
    np.testing.assert_allclose(late[200:], delayed[200:], atol=2e-3)


def test_a_bandwidth_beyond_half_of_the_rate_is_refused() -> None:
    with pytest.raises(ValueError, match=r"imu.gyroscope_bandwidth: expected less than half of"):
        MultirotorConfig(imu=ImuParameters(gyroscope_bandwidth=100.0))
