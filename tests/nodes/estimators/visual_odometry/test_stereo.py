"""Stereo odometry: depth of a pair, the trajectory from it, and the rigs that it refuses."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest

from events import CameraAnnouncement
from nodes.estimators.rectification import ALIGNED, misalignment
from nodes.estimators.surfaces import inverse_depth, surfaces_at
from nodes.estimators.visual_odometry.features import FeatureSettings
from nodes.estimators.visual_odometry.node import StereoTracker
from nodes.estimators.visual_odometry.stereo import StereoMatcher, StereoSettings
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose

BASELINE = 0.1


def pair(camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the images of both eyes, and the true depth of the left one."""
    left, depth = look(camera)
    right, _ = look(camera @ pose(x=BASELINE))
    return left, right, depth


@pytest.mark.parametrize("gain", [1.0, 0.8, 1.05, 1.3])
def test_depth_at_corners_is_within_the_stated_noise(gain: float) -> None:
    matcher = StereoMatcher(INFO, BASELINE)
    left, right, truth = pair(pose(yaw=8.0))
    right = np.minimum(np.rint(right * gain), 255).astype(np.uint8)
    coarse = inverse_depth(matcher.depth(left, right))
    columns, rows = np.meshgrid(np.arange(90, 300, 10), np.arange(20, 220, 10))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    surfaces = matcher.surfaces_at(coarse, pixels, matcher.depth_noise)
    assert surfaces.continuous.mean() > 0.5
    true = 1.0 / truth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    errors = (surfaces.inverse - true)[surfaces.continuous]
    assert np.median(np.abs(errors)) < matcher.depth_noise
    assert np.abs(np.median(errors)) < 0.5 * matcher.depth_noise


def test_corners_on_a_surface_of_one_colour_have_depth() -> None:
    pixels = np.array([(x, y) for x in range(100, 280, 45) for y in range(40, 200, 45)], np.float64)
    left, right = np.full((2, INFO.height, INFO.width), 190, np.uint8)
    for x, y in pixels.astype(int).tolist():
        left[y : y + 9, x : x + 9] = 60
        right[y : y + 9, x - 11 : x - 2] = 60
    matcher = StereoMatcher(INFO, BASELINE)
    coarse = inverse_depth(matcher.depth(left, right))
    assert not surfaces_at(coarse, pixels, matcher.depth_noise).continuous.any()
    surfaces = matcher.surfaces_at(coarse, pixels, matcher.depth_noise)
    assert surfaces.continuous.mean() > 0.8
    assert np.allclose(INFO.fx * BASELINE * surfaces.inverse[surfaces.continuous], 11.0, atol=0.1)


@pytest.mark.slow
def test_a_level_edge_in_noise_has_no_depth() -> None:
    random = np.random.default_rng(2)
    images = np.full((2, INFO.height, INFO.width), 40.0)
    images[:, 120:] = 60.0
    left, right = np.clip(images + random.normal(0.0, 4.0, images.shape), 0, 255).astype(np.uint8)
    matcher = StereoMatcher(INFO, BASELINE)
    coarse = inverse_depth(matcher.depth(left, right))
    columns, rows = np.meshgrid(np.arange(90.0, 300.0), np.arange(114.0, 126.0))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    surfaces = matcher.surfaces_at(coarse, pixels, matcher.depth_noise)
    assert not surfaces.continuous.any()


@pytest.mark.parametrize("other", ["black", "unrelated", "swapped"])
def test_images_that_do_not_match_have_no_depth(other: str) -> None:
    left, right, _ = pair(pose())
    if other == "black":
        right = np.zeros_like(right)
    elif other == "unrelated":
        right = np.random.default_rng(1).integers(0, 255, right.shape, np.uint8)
    else:
        left, right = right, left
    matcher = StereoMatcher(INFO, BASELINE)
    coarse = inverse_depth(matcher.depth(left, right))
    columns, rows = np.meshgrid(np.arange(90, 300, 10), np.arange(20, 220, 10))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    assert matcher.surfaces_at(coarse, pixels, matcher.depth_noise).continuous.mean() < 0.03


@pytest.mark.parametrize("slope", [0.0, 2.3])
def test_each_corner_of_a_new_map_is_an_inlier(slope: float) -> None:
    """Also where rows are off so far that some corners lose their depth once that is known."""
    left, right, _ = pair(pose(yaw=8.0))
    height, width = right.shape[:2]
    off_rows = np.array([[1.0, 0.0, 0.0], [2.0 * slope / width, 1.0, -slope / 2.0]])
    right = cv2.warpAffine(right, off_rows, (width, height), borderMode=cv2.BORDER_REPLICATE)
    tracker = StereoTracker(INFO, BASELINE, StereoSettings(), FeatureSettings())
    result = tracker.track(0, left, np.asarray(right, np.uint8))
    assert len(result.inliers) == len(result.points) > 50


@pytest.mark.slow
def test_the_trajectory_is_metric_and_the_same_twice() -> None:
    def fly() -> list[np.ndarray]:
        tracker = StereoTracker(INFO, BASELINE, StereoSettings(), FeatureSettings())
        poses = []
        for step in range(12):
            left, right, _ = pair(pose(x=0.03 * step, z=0.02 * step, yaw=0.5 * step))
            result = tracker.track(step * 50_000_000, left, right)
            assert not result.lost
            poses.append(result.pose)
        return poses

    poses = fly()
    truth = pose(x=0.33, z=0.22, yaw=5.5)
    assert np.linalg.norm(poses[-1][:3, 3] - truth[:3, 3]) < 0.01
    assert np.abs(poses[-1][:3, :3] - truth[:3, :3]).max() < 0.005
    assert np.array_equal(poses, fly())


def camera(
    name: str, position: tuple[float, float, float], width: int = INFO.width
) -> CameraAnnouncement:
    """Return a camera of this place, looking along z."""
    return CameraAnnouncement(
        stamp=0,
        source=name,
        images=("grey",),
        info=msgspec.structs.replace(INFO, width=width),
        rate=20.0,
        latency=0.0,
        frame_id=name,
        parent_frame_id="base_link",
        position=position,
        orientation=(1.0, 0.0, 0.0, 0.0),
    )


def test_only_rectified_pairs_are_aligned() -> None:
    left = camera("left", (0.2, 0.0, 0.0))
    assert misalignment(left, camera("right", (0.3, 0.0, 0.0))) < 1e-6
    turned = msgspec.structs.replace(
        camera("right", (0.3, 0.0, 0.0)), orientation=(0.99998, 0.00632, 0.0, 0.0)
    )
    for right in (
        camera("right", (0.1, 0.0, 0.0)),
        camera("right", (0.3, 0.01, 0.0)),
        camera("right", (0.3, 0.0, 0.0), width=321),
        turned,
    ):
        assert misalignment(left, right) > ALIGNED
