"""What a calibration leaves of rows and disparities in a rectified pair, and that it is found."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events.geometry import inverse
from nodes.estimators.surfaces import Surfaces, inverse_depth
from nodes.estimators.visual_odometry.features import FeatureSettings
from nodes.estimators.visual_odometry.landmarks import Landmarks, MapMatch
from nodes.estimators.visual_odometry.misalignment import SmoothField, disparity_information
from nodes.estimators.visual_odometry.node import StereoTracker
from nodes.estimators.visual_odometry.stereo import StereoMatcher, StereoSettings
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose

BASELINE = 0.1
UNIT = INFO.fx * BASELINE
FIELD = np.array([0.4, -0.3, 0.2, 0.2, -0.1, 0.1])  # of disparities, pixels


def grid(step: int) -> np.ndarray:
    columns, rows = np.meshgrid(
        np.arange(20.0, INFO.width - 20, step), np.arange(20.0, INFO.height - 20, step)
    )
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def test_a_field_is_the_same_at_pixels_and_everywhere() -> None:
    field = SmoothField(INFO)
    field.coefficients = FIELD
    pixels = grid(17)
    whole = field.everywhere()
    assert whole.shape == (INFO.height, INFO.width)
    columns, rows = pixels.T.astype(int)
    assert np.allclose(whole[rows, columns], field.at(pixels), atol=1e-5)


def test_offsets_are_measured_beside_wrong_ones_and_make_the_field_sure() -> None:
    random = np.random.default_rng(1)
    field, truth, pixels = SmoothField(INFO), SmoothField(INFO), grid(25)
    truth.coefficients = FIELD
    unsure = field.deviation(pixels)
    for _ in range(20):
        offsets = truth.at(pixels) + random.normal(0.0, 0.1, len(pixels))
        offsets[::10] += 3.0
        field.measure(pixels, offsets)
    assert np.abs(field.at(pixels) - truth.at(pixels)).max() < 0.15
    assert (field.deviation(pixels) < 0.1 * unsure).all()
    assert (np.abs(field.at(pixels) - truth.at(pixels)) < 5 * field.deviation(pixels)).mean() > 0.9


def test_disparities_that_err_are_corrected_by_landmarks_seen_in_motion() -> None:
    random = np.random.default_rng(2)
    truth, field, landmarks = SmoothField(INFO), SmoothField(INFO), Landmarks(INFO.matrix())
    truth.coefficients = FIELD
    pixels = grid(30)
    depths = random.uniform(1.0, 6.0, len(pixels))
    rays = np.column_stack(
        [(pixels - (INFO.cx, INFO.cy)) / (INFO.fx, INFO.fy), np.ones(len(pixels))]
    )
    points = rays * depths[:, None]
    flat = np.zeros((len(pixels), 2))
    known = np.ones(len(pixels), np.bool_)
    read = 1.0 / depths - truth.at(pixels) / UNIT
    landmarks.add(0, np.eye(4), pixels, Surfaces(read, flat, known))
    for step in range(1, 25):
        camera = pose(x=0.01 * step, y=0.004 * step, z=0.02 * step, yaw=0.2 * step)
        x, y, z = ((points - camera[:3, 3]) @ camera[:3, :3]).T
        there = np.stack([INFO.fx * x / z + INFO.cx, INFO.fy * y / z + INFO.cy], axis=1)
        seen = (there > 5).all(axis=1) & (there < (INFO.width - 5, INFO.height - 5)).all(axis=1)
        rows = np.flatnonzero(seen)
        now = 1.0 / z[seen] + (field.at(there[seen]) - truth.at(there[seen])) / UNIT
        noisy = there[seen] + random.normal(0.0, 0.1, (len(rows), 2))
        # The pose is another's: it was bent by the same error, which must not matter.
        bent = inverse(camera @ pose(x=0.01, yaw=0.3))
        match = MapMatch(bent, rows, noisy, known[rows], np.empty(0, np.int64))
        surfaces = Surfaces(now, flat[rows], known[rows])
        measured = disparity_information(
            field, UNIT, landmarks, match, surfaces, 0.08 / UNIT, INFO.matrix()
        )
        change = field.update(*measured)
        landmarks.change_depths(field.terms(landmarks.table["pixel"]) @ change / UNIT)
    assert np.abs(field.at(pixels) - truth.at(pixels)).max() < 0.08
    assert np.abs(truth.at(pixels)).max() > 0.4
    errors = landmarks.table["inverse"] - 1.0 / depths
    assert np.abs(errors).max() < 0.1 / UNIT
    assert np.allclose(landmarks.table["place"], rays / landmarks.table["inverse"][:, None])


def test_landmarks_stay_ahead_whatever_their_depth_is_corrected_by() -> None:
    landmarks = Landmarks(INFO.matrix())
    pixels = grid(60)
    count = len(pixels)
    surfaces = Surfaces(np.full(count, 0.2), np.zeros((count, 2)), np.ones(count, np.bool_))
    landmarks.add(0, np.eye(4), pixels, surfaces)
    landmarks.change_depths(np.full(count, -1.0))
    assert (landmarks.table["inverse"] > 0.0).all()
    assert (landmarks.table["place"][:, 2] > 0.0).all()


@pytest.mark.parametrize(("pitch", "roll"), [(0.25, 0.0), (0.0, 0.3), (-0.6, 0.2)])
def test_corners_keep_their_depth_where_the_right_eye_is_turned(pitch: float, roll: float) -> None:
    left, _ = look(pose())
    turned = pose(x=BASELINE, pitch=pitch)
    turned[:3, :3] @= Rotation.from_euler("z", roll, degrees=True).as_matrix()
    right, _ = look(turned)
    matcher = StereoMatcher(INFO, BASELINE)
    coarse = inverse_depth(matcher.depth(left, right))
    pixels = grid(12)
    surfaces = matcher.surfaces_at(coarse, pixels, matcher.depth_noise)
    assert surfaces.continuous.mean() > 0.4
    rays = np.column_stack(
        [(pixels - (INFO.cx, INFO.cy)) / (INFO.fx, INFO.fy), np.ones(len(pixels))]
    )
    _, y, z = (rays @ turned[:3, :3]).T
    offsets = INFO.fy * y / z + INFO.cy - pixels[:, 1]
    assert np.abs(offsets).max() > 0.6
    assert np.abs(matcher.rows.at(pixels) - offsets).max() < 0.4
    assert np.median(np.abs(matcher.rows.at(pixels) - offsets)) < 0.1


def test_images_from_one_place_correct_no_disparity() -> None:
    random = np.random.default_rng(3)
    tracker = StereoTracker(INFO, BASELINE, StereoSettings(), FeatureSettings())
    eyes = look(pose())[0], look(pose(x=BASELINE))[0]
    for step in range(8):
        left, right = (
            np.clip(eye + random.normal(0.0, 3.0, eye.shape), 0, 255).astype(np.uint8)
            for eye in eyes
        )
        assert not tracker.track(step * 50_000_000, left, right).lost
    matcher = tracker._matcher
    assert matcher is not None
    assert matcher.rows.coefficients.any()
    assert not matcher.disparities.coefficients.any()


def test_a_trajectory_is_right_although_the_right_eye_is_turned() -> None:
    def off(yaw: float) -> float:
        tracker = StereoTracker(INFO, BASELINE, StereoSettings(), FeatureSettings())
        for step in range(25):
            camera = pose(x=0.02 * step, z=0.04 * step, yaw=0.3 * step)
            left, _ = look(camera)
            right, _ = look(camera @ pose(x=BASELINE) @ pose(yaw=yaw))
            result = tracker.track(step * 50_000_000, left, right)
            assert not result.lost
        return float(np.linalg.norm(result.pose[:3, 3] - camera[:3, 3]))

    # 0.15° are 0.7 px: without a correction the depth of a wall at 5 m is off by a tenth.
    assert off(0.15) < 0.02
