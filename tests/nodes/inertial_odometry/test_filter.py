"""The filter's derivatives against differences, and rows of a rolling shutter made straight."""

from __future__ import annotations

import msgspec
import numpy as np

from nodes.inertial_odometry.filter import POSE, InertialFilter, Sighting, State
from nodes.inertial_odometry.preintegration import Floats
from nodes.inertial_odometry.rolling_shutter import Rows
from tests.nodes.inertial_odometry.test_preintegration import MODEL, felt
from tests.nodes.visual_odometry.world import INFO, look, pose


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

    for axis in range(18):
        alone = started()
        alone.covariance = np.zeros((18, 18))
        alone.covariance[axis, axis] = 1.0
        motion = MODEL.preintegrate(samples, alone.state.bias)
        alone.propagate(motion)
        exact = started()
        exact.covariance = np.zeros((18, 18))
        exact.propagate(motion)
        # The covariance of one error of size one is the product of its derivative with itself.
        step = 1e-5 * np.eye(18)[axis]
        change = after(-step).error_of(after(step)) / 2e-5
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
    error = np.zeros(18)
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


def test_a_map_that_contradicts_is_not_believed() -> None:
    made = started()
    seen = sighting()
    rest = np.array([[t, 0, 0, 0, 0, 0, -9.81] for t in (0.0, 0.05)])
    made.propagate(MODEL.preintegrate(rest, np.zeros(6)))
    moved = msgspec.structs.replace(seen, measured=seen.measured + np.array([1.0, 0.0, 0.0]))
    before = made.state
    assert not made.update(moved)
    assert made.state is before


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
    found, near = rows.image_and_depth(image, depth)
    inner = np.s_[10:-10, 20:-20]
    before = np.abs(image[inner].astype(float) - straight[inner]).mean()
    assert np.abs(found[inner].astype(float) - straight[inner]).mean() < 0.35 * before
    assert np.median(np.abs(near - true)[inner]) < 0.01
