"""IMU noise: as large as its data sheet says, growing as it should, and the same for a seed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from sims.sensors import ImuNoise, ImuParameters

REST = ((0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
RATE = 200.0


def samples(noise: ImuNoise, count: int) -> npt.NDArray[np.float64]:
    """Return the errors added to a vehicle at rest, shape (count, 6): rad/s, then m/s²."""
    taken = [noise.add(*REST) for _ in range(count)]
    measured = np.array([(*rates, *force) for rates, force in taken], dtype=np.float64)
    truth = np.array([*REST[0], *REST[1]])
    return np.asarray(measured - truth)


def noise_of(seed: int = 0, **parameters: float) -> ImuNoise:
    return ImuNoise(ImuParameters(**parameters), RATE, np.random.default_rng(seed))


def test_white_noise_has_the_density_asked_for() -> None:
    errors = samples(noise_of(gyroscope_random_walk=0.0, accelerometer_random_walk=0.0), 20_000)
    expected = np.repeat([1.7e-4, 2e-3], 3) * np.sqrt(RATE)
    np.testing.assert_allclose(errors.std(axis=0), expected, rtol=0.03)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=4 * expected.max() / 20_000**0.5)


def test_white_noise_averages_out_with_the_root_of_time() -> None:
    """The Allan deviation's slope of -1/2: at 1 s it is the density itself."""
    errors = samples(noise_of(gyroscope_random_walk=0.0, accelerometer_random_walk=0.0), 100_000)
    means = errors.reshape(-1, int(RATE), 6).mean(axis=1)
    deviation = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0))
    np.testing.assert_allclose(deviation, np.repeat([1.7e-4, 2e-3], 3), rtol=0.2)


@pytest.mark.slow
def test_bias_wanders_with_the_root_of_time() -> None:
    """Over many seeds its spread after 5 s and 20 s is random_walk·√t, across blocks too."""
    runs = np.array(
        [
            samples(
                noise_of(seed, gyroscope_noise_density=0.0, accelerometer_noise_density=0.0), 4000
            )[[999, 3999]]
            for seed in range(60)
        ]
    )
    spread = np.sqrt(np.mean(runs**2, axis=0)).reshape(2, 2, 3).mean(axis=2)
    expected = np.outer(np.sqrt([5.0, 20.0]), [2e-5, 3e-3])
    np.testing.assert_allclose(spread, expected, rtol=0.2)


def test_equal_seeds_give_equal_noise_and_others_other() -> None:
    one, same, other = (samples(noise_of(seed), 1200) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_the_six_axes_are_independent() -> None:
    correlation = np.corrcoef(
        samples(noise_of(gyroscope_random_walk=0.0, accelerometer_random_walk=0.0), 20_000).T
    )
    assert np.abs(correlation - np.eye(6)).max() < 0.03


def test_no_noise_is_the_truth() -> None:
    noise = noise_of(
        gyroscope_noise_density=0.0,
        gyroscope_random_walk=0.0,
        accelerometer_noise_density=0.0,
        accelerometer_random_walk=0.0,
    )
    assert noise.add((0.1, 0.2, 0.3), (1.0, 2.0, 3.0)) == ((0.1, 0.2, 0.3), (1.0, 2.0, 3.0))


def test_impossible_noise_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="gyroscope_random_walk: expected a number >= 0"):
        noise_of(gyroscope_random_walk=-1.0)
    with pytest.raises(ValueError, match="rate"):
        ImuNoise(ImuParameters(), 0.0, np.random.default_rng())
