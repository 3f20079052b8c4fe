"""The filter's derivatives against differences, and rows of a rolling shutter made straight."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nodes.estimators.inertial_odometry.filter import POSE, InertialFilter, P, Sighting, State
from nodes.estimators.inertial_odometry.preintegration import Floats, Rows
from tests.nodes.estimators.inertial_odometry.test_preintegration import MODEL, felt
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose


def error(state: State, other: State) -> Floats:
    """Return the difference of another state from a state, shape (17,)."""
    x, y, z = state.level.T @ other.level[:, 2]
    tilt = np.array([-y, x]) * (np.arctan2(np.hypot(x, y), z) / max(np.hypot(x, y), 1e-12))
    turn = Rotation.from_matrix(state.rotation.T @ other.rotation).as_rotvec()
    moved = other.position - state.position, other.velocity - state.velocity
    return np.concatenate([turn, *moved, other.bias - state.bias, tilt])


def started() -> InertialFilter:
    """Return a filter that has begun at rest, and remembers its first image."""
    made = InertialFilter(MODEL, pose(x=0.1, y=-0.05, yaw=20.0), 5)
    made.start(np.array([0.0, 0.0, -9.81]))
    made.remember(0)
    return made


def test_propagation_is_linear_in_the_state_as_the_covariance_says() -> None:
    samples = felt(np.linspace(-1, 1, 12), np.linspace(0, 0.1, 21))

    def after(error: Floats) -> State:
        made = started()
        made.state = made.state.moved(error)
        made.propagate(MODEL.preintegrate(samples, made.state.bias))
        return made.state

    for axis in range(17):
        alone = started()
        alone.covariance = np.zeros((17, 17))
        alone.covariance[axis, axis] = 1.0
        motion = MODEL.preintegrate(samples, alone.state.bias)
        alone.propagate(motion)
        exact = started()
        exact.covariance = np.zeros((17, 17))
        exact.propagate(motion)
        # The covariance of one error of size one is the product of its derivative with itself.
        step = 1e-5 * np.eye(17)[axis]
        change = error(after(-step), after(step)) / 2e-5
        grown = alone.covariance - exact.covariance
        assert np.allclose(grown, np.outer(change, change), atol=2e-3), axis


def sighting(count: int = 40) -> Sighting:
    """Return landmarks that the camera sees from where the filter began."""
    random = np.random.default_rng(3)
    places = random.uniform((-1, -1, 2), (1, 1, 5), (count, 3))
    measured = places / places[:, 2:]
    measured[:, 2] = 1.0 / places[:, 2]
    return Sighting(places, np.zeros(count, np.int64), measured, np.full((count, 3), 500.0))


def test_landmarks_correct_the_pose_and_nothing_is_more_certain_than_its_key_frame() -> None:
    made = started()
    rest = np.array([[t, 0, 0, 0, 0, 0, -9.81] for t in (0.0, 0.05)])
    made.propagate(MODEL.preintegrate(rest, np.zeros(6)))
    error = np.zeros(17)
    error[POSE] = (0.01, -0.02, 0.01, 0.05, -0.03, 0.02)
    made.state = made.state.moved(error)
    seen = sighting()
    assert made.update(seen)
    first = started().state
    assert np.abs(made.state.position - first.position).max() < 2e-3
    assert np.abs(made.state.rotation - first.rotation).max() < 2e-3
    assert np.linalg.eigvalsh(made.covariance).min() > -1e-9
    # A key frame made in doubt leaves all that is placed by it in doubt.
    doubtful = started()
    doubtful.covariance[POSE, POSE] = 0.04 * np.eye(6)
    doubtful.remember(0)
    assert doubtful.update(seen)
    assert np.sqrt(np.diag(doubtful.covariance)[POSE]).min() > 0.19


def test_many_landmarks_with_errors_in_common_tell_no_more_than_a_few() -> None:
    def deviation(count: int, common: tuple[float, float]) -> float:
        made = InertialFilter(MODEL, np.eye(4), 5, common)
        made.start(np.array([0.0, 0.0, -9.81]))
        made.covariance[POSE, POSE] = np.eye(6)
        made.remember(0, sighting(count))
        made.covariance[POSE, POSE] += np.eye(6)
        assert made.update(sighting(count))
        return float(np.sqrt(made.covariance[P, P].trace() - 3.0))

    for common in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1)):
        few, many = deviation(50, common), deviation(800, common)
        assert (many < 0.5 * few) == (common == (0.0, 0.0)), (few, many)


@pytest.mark.parametrize("common", [0.0, 1.0])
def test_a_motion_is_as_uncertain_as_the_depth_of_the_landmarks_that_it_is_seen_by(
    common: float,
) -> None:
    made = InertialFilter(MODEL, np.eye(4), 5, (0.0, common))
    made.start(np.array([0.0, 0.0, -9.81]))
    made.covariance[POSE, POSE] = 1e-12 * np.eye(6)
    seen = sighting(100)
    seen = msgspec.structs.replace(seen, places=seen.places * (4.0 / seen.places[:, 2:]))
    doubtful = np.full((100, 3), 500.0)
    doubtful[:, 2] = 1.0 / 0.02  # 8 % of their inverse depth, together or each for itself
    for sideways in (0.0, 1.0):
        measured = (seen.places - (sideways, 0.0, 0.0)) / 4.0
        measured[:, 2] = 0.25
        now = msgspec.structs.replace(seen, measured=measured, scale=doubtful)
        if not sideways:
            made.remember(0, now)
        made.state = made.state.moved(np.r_[np.zeros(3), sideways, np.zeros(13)])
        made.covariance[POSE, POSE] += 0.04 * np.eye(6)
    assert made.update(now)
    spread = np.sqrt(made.covariance[P.start, P.start])
    assert (spread > 0.07) == (common == 1.0), spread


def test_a_map_that_contradicts_is_not_believed() -> None:
    made = started()
    seen = sighting()
    rest = np.array([[t, 0, 0, 0, 0, 0, -9.81] for t in (0.0, 0.05)])
    made.propagate(MODEL.preintegrate(rest, np.zeros(6)))
    moved = msgspec.structs.replace(seen, measured=seen.measured + np.array([1.0, 0.0, 0.0]))
    before = made.state
    assert not made.update(moved)
    assert made.state is before


@pytest.mark.slow
def test_rows_of_a_turning_and_moving_camera_are_made_straight() -> None:
    readout, turn, speed = 0.025, 1.0, 1.0
    times = readout * (np.arange(INFO.height) / (INFO.height - 1) - 0.5)
    moments = np.linspace(times[0], times[-1], 25)
    shown = [look(pose(x=speed * t, yaw=np.degrees(turn * t))) for t in moments]
    nearest = np.abs(times[:, None] - moments).argmin(axis=1)
    image = np.stack([shown[at][0][row] for row, at in enumerate(nearest)])
    depth = np.stack([shown[at][1][row] for row, at in enumerate(nearest)])
    straight, true = look(pose())
    rows = Rows(INFO, readout, np.array([0.0, turn, 0.0]), np.array([speed, 0.0, 0.0]))
    straightened, near = rows.image_and_depth(image, depth)
    inner = np.s_[10:-10, 20:-20]
    before = np.abs(image[inner].astype(float) - straight[inner]).mean()
    assert np.abs(straightened[inner].astype(float) - straight[inner]).mean() < 0.35 * before
    assert np.median(np.abs(near - true)[inner]) < 0.01


def flight(seed: int) -> Iterator[tuple[InertialFilter, Floats, float]]:
    """Fly off from an acceleration of 3.4 m/s²; yield filter, true velocity, NEES of position."""
    random = np.random.default_rng(seed)
    down, shape = np.array([0.0, 9.81, 0.0]), (60, 3)
    scale = np.broadcast_to([400.0, 400.0, 1000.0], shape)
    bias = random.normal(0.0, [0.01] * 3 + [0.1] * 3)

    def at(t: Floats) -> tuple[Floats, Floats]:
        wave = np.stack([np.sin(t), 0.3 * np.sin(2 * t), 0.2 * np.sin(1.5 * t)], axis=-1)
        turns = 0.1 * np.stack([np.sin(t), np.sin(0.7 * t), np.sin(1.3 * t)], axis=-1)
        wave[..., 0] += 3.4 * (1.0 - np.cos(t))
        return wave, Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()

    def samples(times: Floats) -> Floats:
        (ahead, after), (behind, before), (now, turned) = (at(times + d) for d in (1e-4, -1e-4, 0))
        rates = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / 2e-4
        force = np.einsum("nji,nj->ni", turned, (ahead + behind - 2 * now) / 1e-8 - down)
        noise = random.standard_normal((len(times), 6)) * np.repeat(MODEL.noise / 2, 3) * 14.0
        return np.column_stack([times, np.hstack([rates, force]) + bias + noise])

    def seen(places: Floats, t: float, share: float) -> Floats:
        position, rotation = at(np.array(t))
        there = (places - position) @ rotation[0]
        image = np.column_stack([there[:, :2], np.ones(len(there))]) / there[:, 2:]
        return np.asarray(image + random.standard_normal(shape) * share / scale)

    true = random.uniform((-4, -3, 3), (8, 3, 8), shape)
    first = seen(true, 0.0, 0.5)  # which places them, so this error lasts
    places = np.column_stack([first[:, :2], np.ones(60)]) / first[:, 2:]
    number = np.zeros(60, np.int64)
    made = InertialFilter(MODEL, np.eye(4), 5)
    made.start(samples(np.array([0.0]))[0, 4:])
    made.remember(0, Sighting(places, number, first, scale / 0.5))
    for begin in np.arange(0.0, 3.0, 0.05):
        motion = samples(np.linspace(begin, begin + 0.05, 11))
        made.propagate(MODEL.preintegrate(motion, made.state.bias))
        assert made.update(Sighting(places, number, seen(true, begin + 0.05, 1.0), scale))
        position, velocity = at(np.array(begin + 0.05))[0], np.diff(at(begin + H)[0], axis=0)[0]
        error = made.state.position - position
        nees = float(error @ np.linalg.solve(made.covariance[P, P], error))
        yield made, np.asarray(velocity / 2e-4), nees


H = np.array([0.05 - 1e-4, 0.05 + 1e-4])


@pytest.mark.slow
def test_a_start_in_motion_with_gravity_20_degrees_off_converges_and_knows_its_error() -> None:
    consistent = []
    for seed in range(6):
        *_, (made, velocity, _) = (rows := list(flight(seed)))
        assert np.abs(made.state.velocity - velocity).max() < 0.05
        assert np.degrees(np.arccos(made.state.level[1, 2])) < 1.0  # as the bias is 0.1 m/s²
        assert np.isclose(np.linalg.norm(made.state.gravity), 9.81)
        consistent.append(np.mean([row[2] for row in rows]))
    assert 1.0 < np.mean(consistent) < 6.0


@pytest.mark.slow
def test_two_landmarks_do_not_carry_the_camera_off() -> None:
    *_, (made, _, _) = flight(0)
    before = made.state
    for places in (np.array([[90.0, 3, 90], [95, -3, 95]]), np.array([[0.1, 0, 3], [0, 0.1, -9]])):
        measured = np.array([[0.4, 0.1, 0.4], [-0.3, 0.2, 0.3]])
        assert not made.update(
            Sighting(places, np.zeros(2, np.int64), measured, np.full((2, 3), 400.0))
        )
        assert made.state is before


def test_an_error_common_to_depths_leaves_what_is_seen_from_elsewhere_less_certain() -> None:
    def deviation(common: float) -> float:
        made, seen = started(), sighting()
        made.remember(1, seen, common)
        made.state = msgspec.structs.replace(made.state, position=made.state.position + 0.5)
        made.covariance[P, P] += np.eye(3)
        there = msgspec.structs.replace(seen, keyframes=np.ones(len(seen.places), np.int64))
        image = made._image(made.state, there)[2]
        assert made.update(msgspec.structs.replace(there, measured=image))
        return float(np.sqrt(np.trace(made.covariance[P, P])))

    assert deviation(0.05) > 1.05 * deviation(0.0)
