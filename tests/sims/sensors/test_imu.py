"""The IMU: noise as large as its data sheet says, and each error of its own kind.

The IMU on a vehicle: true at its own place, and integrated, it gives the flight back.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import Imu, ImuAnnouncement, TransformStamped
from events.frames import from_rpy, multiply, rotate
from runtime.testing import run_node
from sims.multirotor import Multirotor
from sims.sensors.imu import (
    NOISES,
    ImuModel,
    ImuNoise,
    ImuParameters,
    Motion,
    mean_between,
    motion_at,
)
from sims.sensors.suite import mount_imu
from sims.sensors.vibration import Vibration
from sims.vehicle import Physics, State, attach_vehicle
from tests.sims.sensors.truths import PLACE, random
from tests.sims.vehicle.flight import UP, WORLD, Flight, airborne, velocity

REST = ((0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
RATE = 200.0


def samples(noise: ImuNoise, count: int) -> npt.NDArray[np.float64]:
    """Return the errors added to a vehicle at rest, shape (count, 6): rad/s, then m/s²."""
    taken = [noise.add(*REST) for _ in range(count)]
    measured = np.array([(*rates, *force) for rates, force in taken], dtype=np.float64)
    truth = np.array([*REST[0], *REST[1]])
    return np.asarray(measured - truth)


def noise_of(seed: int = 0, **parameters: Any) -> ImuNoise:
    return ImuNoise(ImuParameters(**parameters), RATE, np.random.default_rng(seed))


def test_white_noise_has_the_density_asked_for() -> None:
    errors = samples(noise_of(gyroscope_random_walk=0.0, accelerometer_random_walk=0.0), 20_000)
    expected = np.repeat([1.7e-4, 2e-3], 3) * np.sqrt(RATE)
    np.testing.assert_allclose(errors.std(axis=0), expected, rtol=0.03)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=4 * expected.max() / 20_000**0.5)


@pytest.mark.slow
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


HOVER = (0.45, 0.45, 0.45, 0.45)


def model_of(seed: int = 0, rate: float = RATE, **parameters: Any) -> ImuModel:
    """Return an IMU without noise, but with the errors asked for."""
    silent = dict.fromkeys(NOISES, 0.0)
    noise, constants = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    return ImuModel(ImuParameters(**(silent | parameters)), rate, noise, constants, PLACE)


def taken(model: ImuModel, count: int) -> npt.NDArray[np.float64]:
    rows = [
        (*rates, *force) for rates, force in (model.measure(*REST, HOVER) for _ in range(count))
    ]
    return np.array(rows)


def allan_variances(
    values: npt.NDArray[np.float64], sizes: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Return overlapping Allan variances, shape (sizes, 6), of samples, shape (n, 6)."""
    total = np.vstack([np.zeros(6), np.cumsum(values, axis=0)])
    variances = []
    for size in sizes:
        means = (total[size:] - total[:-size]) / size
        variances.append(0.5 * np.mean((means[size:] - means[:-size]) ** 2, axis=0))
    return np.array(variances)


def errors_of(noise: ImuNoise, count: int) -> Any:
    """Return the errors of the next samples, rad/s and m/s², shape (count, 6)."""
    still = (0.0, 0.0, 0.0)
    return np.array(
        [(*rates, *force) for rates, force in (noise.add(still, still) for _ in range(count))]
    )


def densities_of(values: npt.NDArray[np.float64], rate: float) -> npt.NDArray[np.float64]:
    """Return noise density and random walk of gyroscope and accelerometer, shape (2, 2).

    Fits N²/τ + K² τ/3 (IEEE Std 952, annex C) to their Allan variances, whose relative error
    grows with √τ.
    """
    sizes = np.unique(np.geomspace(2, 50 * rate, 24).astype(np.int64))
    variances = allan_variances(values, sizes).reshape(-1, 2, 3).mean(axis=2)
    seconds = sizes / rate
    squared = []
    for sensor in range(2):
        weight = 1.0 / (variances[:, sensor] * np.sqrt(seconds))
        terms = np.column_stack([1.0 / seconds, seconds / 3.0]) * weight[:, None]
        squared.append(np.linalg.lstsq(terms, variances[:, sensor] * weight, rcond=None)[0])
    return np.sqrt(squared)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_allan_deviation_gives_the_announced_numbers(seed: int) -> None:
    rate = 50.0
    noise = ImuNoise(ImuParameters(), rate, np.random.default_rng(seed))
    announced = model_of(rate=rate, **_noise_fields(ImuParameters())).announcement()
    expected = [
        [announced.gyroscope_noise_density, announced.gyroscope_random_walk],
        [announced.accelerometer_noise_density, announced.accelerometer_random_walk],
    ]
    densities = densities_of(errors_of(noise, int(4 * 3600 * rate)), rate)
    np.testing.assert_allclose(densities, expected, rtol=0.1)


@pytest.mark.slow
def test_an_imu_that_is_worse_than_announced_is_found_by_its_allan_deviation() -> None:
    worse = ImuParameters(gyroscope_noise_density=2.1e-4)
    densities = densities_of(
        errors_of(ImuNoise(worse, 50.0, np.random.default_rng(1)), 360_000), 50.0
    )
    assert densities[0, 0] > 1.1 * ImuParameters().gyroscope_noise_density


def _noise_fields(parameters: ImuParameters) -> dict[str, Any]:
    return {name: getattr(parameters, name) for name in NOISES}


def test_an_ideal_imu_tells_the_truth_whatever_else_its_settings_say() -> None:
    worst = ImuParameters(
        ideal=True,
        gyroscope_turn_on_bias=1.0,
        accelerometer_scale_error=0.5,
        g_sensitivity=1.0,
        gyroscope_range=0.1,
        accelerometer_resolution=1.0,
        vibration=Vibration(amplitude=9.0),
        sampling="mean",
    )
    model = ImuModel(worst, RATE, np.random.default_rng(0), np.random.default_rng(1), PLACE)
    assert model.measure((1.0, 2.0, 3.0), (4.0, 5.0, 6.5), HOVER) == ((1, 2, 3), (4, 5, 6.5))
    announced = model.announcement()
    assert announced.averaged
    assert announced.gyroscope_noise_density == announced.vibration == 0.0
    assert announced.gyroscope_range == announced.gyroscope_turn_on_bias == 0.0


def test_the_bias_at_the_start_is_drawn_once_with_its_deviation() -> None:
    starts = []
    for seed in range(300):
        rows = taken(model_of(seed, gyroscope_turn_on_bias=0.02, accelerometer_turn_on_bias=0.3), 3)
        np.testing.assert_array_equal(rows[0], rows[2])
        starts.append(rows[0] - (0, 0, 0, 0, 0, -9.81))
    spread = np.std(starts, axis=0)
    np.testing.assert_allclose(spread, np.repeat([0.02, 0.3], 3), rtol=0.15)


def test_the_matrix_is_the_announced_one() -> None:
    model = model_of(gyroscope_scale_error=0.01, accelerometer_misalignment=0.02)
    announced = model.announcement()
    gyroscope, accelerometer = (
        np.reshape(m, (3, 3)) for m in (announced.gyroscope_matrix, announced.accelerometer_matrix)
    )
    rates, force = model.measure((1.0, -2.0, 3.0), (4.0, 5.0, -6.0), HOVER)
    np.testing.assert_allclose(rates, gyroscope @ (1.0, -2.0, 3.0))
    np.testing.assert_allclose(force, accelerometer @ (4.0, 5.0, -6.0))
    assert np.count_nonzero(gyroscope - np.diag(np.diag(gyroscope))) == 0
    np.testing.assert_array_equal(np.diag(accelerometer), 1.0)
    assert 0.0 < np.abs(accelerometer - np.eye(3)).max() < 0.1


def test_given_matrices_are_used_and_must_have_nine_numbers() -> None:
    turned = (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 2.0)
    model = model_of(gyroscope_matrix=turned, gyroscope_scale_error=0.5)
    assert model.measure((1.0, 2.0, 3.0), REST[1], HOVER)[0] == (2.0, -1.0, 6.0)
    with pytest.raises(ValueError, match=r"accelerometer_matrix: expected 9 numbers.*found 3"):
        ImuParameters(accelerometer_matrix=(1.0, 2.0, 3.0))


def test_an_acceleration_feigns_a_turn() -> None:
    rates, _ = model_of(g_sensitivity=1e-3).measure((0.0, 0.0, 0.0), (1.0, 2.0, -9.0), HOVER)
    assert rates == pytest.approx((1e-3, 2e-3, -9e-3))


@given(value=st.floats(-50, 50), limit=st.floats(0.5, 40), step=st.floats(1e-4, 0.4))
def test_it_shows_whole_steps_up_to_its_range(value: float, limit: float, step: float) -> None:
    model = model_of(accelerometer_range=limit, accelerometer_resolution=step)
    _, (x, _, _) = model.measure((0.0, 0.0, 0.0), (value, 0.0, 0.0), HOVER)
    assert abs(x) <= limit
    if abs(x) < limit:
        assert abs(x - value) <= step * 0.500001
        assert x / step == pytest.approx(round(x / step), abs=1e-6)
    else:
        assert abs(value) >= limit - 0.500001 * step


def test_vibration_is_at_multiples_of_the_rotors_speed_and_as_strong_as_its_square() -> None:
    """At 2/9 of the thrust a rotor of 130 revolutions a second turns with 61.3."""
    shaken = Vibration(amplitude=2.0, rotor_speed=130.0, harmonics=(1.0, 0.5))
    model = model_of(rate=1000.0, vibration=shaken)
    thrusts = (2 / 9, 0.0, 0.0, 0.0)
    rows = np.array([model.measure(*REST, thrusts)[1] for _ in range(4000)])
    spectrum = np.abs(np.fft.rfft(rows - rows.mean(axis=0), axis=0)) / 2000.0
    frequency = np.fft.rfftfreq(4000, 1e-3)
    expected = 130.0 * math.sqrt(2 / 9)
    assert frequency[spectrum[:, 0].argmax()] == pytest.approx(expected, abs=0.3)
    assert frequency[spectrum[:, 2].argmax()] == pytest.approx(2 * expected, abs=0.3)
    assert np.ptp(rows[:, 0]) / 2 == pytest.approx(2.0 * 2 / 9, rel=0.01)
    assert np.ptp(rows[:, 2]) / 2 == pytest.approx(0.5 * 2.0 * 2 / 9, rel=0.02)
    np.testing.assert_array_equal(
        [model.measure(*REST, (0.0,) * 4)[1] for _ in range(3)], [REST[1]] * 3
    )


def test_mean_samples_filter_vibration() -> None:
    """A sinc of frequency over rate: a rotor that turns once a period leaves no trace."""
    shaken = Vibration(amplitude=2.0, rotor_speed=100.0, harmonics=(1.0,))
    thrusts = (1.0, 0.0, 0.0, 0.0)
    for rate, share in ((100.0, 0.0), (400.0, np.sinc(0.25))):
        model = model_of(rate=rate, vibration=shaken, sampling="mean")
        rows = np.array([model.measure(*REST, thrusts)[1] for _ in range(400)])
        assert np.hypot(rows[:, 0], rows[:, 1]).max() == pytest.approx(2.0 * share, abs=1e-9)


@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    turn=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    velocities=st.tuples(*[st.floats(-9, 9)] * 6),
)
def test_mean_samples_integrate_to_the_very_motion(
    angles: tuple[float, ...], turn: tuple[float, ...], velocities: tuple[float, ...]
) -> None:
    """Turning by rates · dt gives the later orientation, and the force halfway the velocity."""
    start = from_rpy(*angles)
    half = _turn(tuple(x / 2 for x in turn))
    before = Motion(start, velocities[:3])  # type: ignore[arg-type]
    after = Motion(multiply(start, multiply(half, half)), velocities[3:])  # type: ignore[arg-type]
    rates, force = mean_between(before, after, 0.005, 9.81)
    np.testing.assert_allclose(np.multiply(rates, 0.005), turn, atol=1e-12)
    halfway = multiply(start, half)
    gained = np.multiply(np.add(rotate(halfway, force), (0.0, 0.0, 9.81)), 0.005)
    np.testing.assert_allclose(gained, np.subtract(after.velocity, before.velocity), atol=1e-11)


def _turn(vector: tuple[float, ...]) -> tuple[float, float, float, float]:
    angle = math.hypot(*vector)
    scale = math.sin(angle / 2) / angle if angle else 0.5
    x, y, z = (scale * v for v in vector)
    return (math.cos(angle / 2), x, y, z)


def test_an_imu_off_the_centre_moves_with_the_body() -> None:
    """Turning right at 2 rad/s, a place 0.5 m ahead moves to the right."""
    parameters = ImuParameters(position=(0.5, 0.0, 0.0), orientation=(0.0, 0.0, 90.0))
    motion = motion_at(parameters, (1.0, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    assert motion.velocity == pytest.approx((3.0, 1.0, 0.0))
    assert rotate(motion.orientation, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))


def test_defaults_are_the_noise_alone() -> None:
    """What was drawn before there were other errors is drawn still, to the bit."""
    noise = ImuNoise(ImuParameters(), RATE, np.random.default_rng(3))
    model = ImuModel(ImuParameters(), RATE, random(3), random(9), PLACE)
    for _ in range(600):
        assert model.measure(*REST, HOVER) == noise.add(*REST)


def test_settings_survive_a_file() -> None:
    parameters = ImuParameters(vibration=Vibration(amplitude=1.0), sampling="mean")
    text = msgspec.json.encode(parameters, enc_hook=float)
    assert msgspec.json.decode(text, type=ImuParameters, dec_hook=lambda kind, x: kind(x)) == (
        parameters
    )


Row = tuple[float, State, tuple[float, float, float], tuple[float, float, float]]


def aggressive(flight: Flight, seconds: float) -> list[Row]:
    """Fly at up to 6 m/s with yaw, and return time, state and instant IMU at 200 Hz."""
    rows = []
    for tick in range(round(seconds * 400) + 1):
        stamp, physics = flight.stamp, flight.physics
        physics.advance_to(stamp)
        if tick % 2 == 0:
            rows.append((stamp / 1e9, physics.state(), *physics.imu()))
        t = stamp / 1e9
        x, y = [(6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0), (6.0, 6.0)][int(t) % 5]
        order = velocity(stamp, x, y, math.sin(3 * t), yaw_rate=2 * math.sin(2 * t))
        flight.autopilot.command(order)
        physics.set_motors(*flight.autopilot.update(stamp, physics.state(), False))
        flight.ticks += 1
    return rows


def turned(vector: Any) -> tuple[float, float, float, float]:
    angle = math.hypot(*vector)
    scale = math.sin(angle / 2) / angle if angle else 0.5
    x, y, z = (scale * v for v in vector)
    return (math.cos(angle / 2), x, y, z)


def integrated(rows: list[Row], mean: bool) -> float:
    """Return by how many metres the integral of the samples misses the last true position.

    Samples of their stamps by the trapezoid, means each over its own period.
    """
    start = rows[0][1]
    q, v, p = start.orientation, np.array(start.velocity), np.array(start.position)
    for (t, s, w, f), (t2, s2, w2, f2) in pairwise(rows):
        dt = t2 - t
        if mean:
            parameters = ImuParameters()
            a, b = (motion_at(parameters, x.orientation, x.velocity, (0, 0, 0)) for x in (s, s2))
            w, f = w2, f2 = mean_between(a, b, dt, 9.81)
        half = turned(np.add(w, w2) * dt / 4)
        after = multiply(q, multiply(half, half))
        if mean:
            force = np.array(rotate(multiply(q, half), f))
        else:
            force = np.add(rotate(q, f), rotate(after, f2)) / 2
        acceleration = np.add(force, (0, 0, 9.81))
        p, v, q = p + v * dt + acceleration * dt**2 / 2, v + acceleration * dt, after
    return math.dist(p, rows[-1][1].position)


@pytest.mark.slow
def test_the_ideal_imu_integrates_to_the_truth_on_an_aggressive_flight() -> None:
    """5 s at 200 Hz, up to 5.4 m/s and 7 rad/s. The mean over each period is good to millimetres;
    instants are not within 1 cm here, since between two they miss what the motors do."""
    rows = aggressive(airborne(), 5.0)
    assert max(math.hypot(*s.velocity) for _, s, _, _ in rows) > 5.0
    assert integrated(rows, mean=True) < 0.005
    assert integrated(rows, mean=False) < 0.03


def test_the_specific_force_at_a_mounted_imu_is_that_of_its_own_place() -> None:
    """MuJoCo's accelerometer there, against the mean over the millisecond that the true velocity of
    the place tells, while it begins to tumble: without the lever it is wrong by metres per s²."""
    parameters = ImuParameters(position=(0.3, -0.2, 0.1), orientation=(20.0, -30.0, 75.0))
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "drone", (0.0, 0.0, -UP), 0.0)
    mount_imu(spec, "drone", parameters)
    physics = Physics(spec.compile(), "drone")
    physics.data.act[:] = (0.5, 0.45, 0.48, 0.52)
    physics.set_motors(0.6, 0.4, 0.3, 0.5)
    for stamp in range(0, 150_000_000, 1_000_000):
        physics.advance_to(stamp)
        rates, force = physics.imu()
        s = physics.state()
        before = motion_at(parameters, s.orientation, s.velocity, s.angular_velocity)
        physics.advance_to(stamp + 1_000_000)
        s = physics.state()
        after = motion_at(parameters, s.orientation, s.velocity, s.angular_velocity)
        mean_rates, mean_force = mean_between(before, after, 1e-3, 9.81)
        assert rates == pytest.approx(mean_rates, abs=0.05)
        assert force == pytest.approx(mean_force, abs=0.2)
    assert math.hypot(*rates) > 2.0


def test_what_is_announced_is_what_is_sent(tmp_path: Any) -> None:
    world = tmp_path / "tiny.xml"
    world.write_text(WORLD)
    imu = {"position": [0.1, 0.0, 0.0], "orientation": [180, 0, 0], "sampling": "mean"}
    config = {"world": str(world), "imu": imu | {"accelerometer_range": 5.0}}
    result = run_node(Multirotor, config=config, duration=0.2, name="drone")
    (announced,) = result.of(ImuAnnouncement)
    assert (announced.frame_id, announced.parent_frame_id) == ("drone/imu", "base_link")
    assert announced.position == (0.1, 0.0, 0.0)
    assert announced.averaged
    (mounted,) = result.of(TransformStamped)
    assert (mounted.child_frame_id, mounted.translation) == ("drone/imu", (0.1, 0.0, 0.0))
    samples = result.of(Imu)
    assert {s.frame_id for s in samples} == {"drone/imu"}
    assert {s.linear_acceleration[2] for s in samples} == {5.0}  # upside down, and cut off


def test_a_model_takes_its_constants_from_a_source_of_their_own() -> None:
    one, other = (
        ImuModel(ImuParameters(), 200.0, random(1), random(seed), PLACE) for seed in (2, 3)
    )
    rest = ((0.0, 0.0, 0.0), (0.0, 0.0, -9.81), (0.5,) * 4)
    assert one.measure(*rest) == other.measure(*rest)
