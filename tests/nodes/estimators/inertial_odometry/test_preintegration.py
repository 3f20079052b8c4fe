"""Preintegration against motion integrated finely, and its derivatives against differences."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import ImuAnnouncement
from nodes.estimators.inertial_odometry.preintegration import Floats, ImuModel, Preintegrated

IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="base_link",
    gyroscope_noise_density=1.7e-4,
    gyroscope_random_walk=2e-5,
    accelerometer_noise_density=2e-3,
    accelerometer_random_walk=3e-3,
)
MODEL = ImuModel(IMU)

motions = st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12).map(np.array)
biases = st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6).map(np.array)


def felt(motion: Floats, times: Floats) -> Floats:
    """Return samples of smoothly changing rates."""
    wave = np.sin(2.0 * times[:, None] + np.arange(6))
    return np.column_stack([times, motion[:6] + motion[6:] * wave])


def integrated(samples: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rotation, velocity and position by Euler's steps."""
    turn, velocity, position = Rotation.identity(), np.zeros(3), np.zeros(3)
    for before, after in itertools.pairwise(samples):
        dt, rates = after[0] - before[0], (before[1:] + after[1:]) / 2
        half = turn * Rotation.from_rotvec(rates[:3] * dt / 2)
        position = position + velocity * dt + half.apply(rates[3:]) * dt * dt / 2
        velocity = velocity + half.apply(rates[3:]) * dt
        turn = turn * Rotation.from_rotvec(rates[:3] * dt)
    return turn.as_matrix(), velocity, position


def difference(of: Preintegrated, other: Preintegrated) -> Floats:
    turn = Rotation.from_matrix(of.rotation.T @ other.rotation).as_rotvec()
    return np.concatenate([turn, other.velocity - of.velocity, other.position - of.position])


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(motions)
def test_samples_at_200_hz_give_the_motion_that_fine_steps_give(motion: Floats) -> None:
    coarse = MODEL.preintegrate(felt(motion, np.linspace(0, 0.1, 21)), np.zeros(6))
    rotation, velocity, position = integrated(felt(motion, np.linspace(0, 0.1, 401)))
    assert np.abs(coarse.rotation - rotation).max() < 2e-5
    assert np.abs(coarse.velocity - velocity).max() < 1e-4
    assert np.abs(coarse.position - position).max() < 1e-5


@settings(max_examples=15, deadline=None)
@given(motions, biases)
def test_derivatives_by_the_bias_are_those_of_differences(motion: Floats, bias: Floats) -> None:
    samples = felt(motion, np.linspace(0, 0.1, 21))
    preintegrated = MODEL.preintegrate(samples, bias)
    for axis, step in enumerate(1e-5 * np.eye(6)):
        ahead = difference(preintegrated, MODEL.preintegrate(samples, bias + step))
        behind = difference(preintegrated, MODEL.preintegrate(samples, bias - step))
        assert np.abs((ahead - behind) / 2e-5 - preintegrated.by_bias[:, axis]).max() < 2e-4


@pytest.mark.slow
def test_the_covariance_is_that_of_noisy_samples() -> None:
    random = np.random.default_rng(1)
    samples = felt(np.linspace(-1, 1, 12), np.linspace(0, 0.2, 41))
    exact = MODEL.preintegrate(samples, np.zeros(6))
    errors = []
    for _ in range(200):
        noisy = samples.copy()
        white = random.standard_normal((41, 6)) * np.repeat(MODEL.noise, 3) / np.sqrt(0.005)
        noisy[:, 1:] += white
        errors.append(difference(exact, MODEL.preintegrate(noisy, np.zeros(6))))
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(exact.covariance))
    assert np.all((ratio > 0.8) & (ratio < 1.2)), ratio


def test_a_gap_makes_the_motion_uncertain() -> None:
    times = np.array([0.0, 0.005, 0.105, 0.11])
    gap = MODEL.preintegrate(felt(np.zeros(12), times), np.zeros(6))
    assert np.sqrt(gap.covariance[3, 3]) > 0.1


def test_announced_scale_and_misalignment_are_undone() -> None:
    matrix = (1.02, 0.01, 0.0, 0.0, 0.98, 0.02, -0.01, 0.0, 1.01)
    model = ImuModel(msgspec.structs.replace(IMU, accelerometer_matrix=matrix))
    true = felt(np.linspace(-1, 1, 12), np.linspace(0, 0.1, 21))
    seen = np.hstack([true[:, :4], true[:, 4:] @ np.reshape(matrix, (3, 3)).T])
    assert np.allclose(model.corrected(seen), true)
