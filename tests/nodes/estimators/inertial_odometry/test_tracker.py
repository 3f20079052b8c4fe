"""The tracker by the images of a small world, and an IMU that agrees with them or does not."""

from __future__ import annotations

import numpy as np
import pytest

from events import CameraAnnouncement
from nodes.estimators import TrackingResult
from nodes.estimators.inertial_odometry.tracker import InertialSettings, InertialTracker
from nodes.estimators.visual_odometry.features import FeatureSettings
from nodes.estimators.visual_odometry.stereo import StereoSettings
from tests.nodes.estimators.inertial_odometry.test_preintegration import IMU
from tests.nodes.estimators.visual_odometry.test_stereo import BASELINE, pair
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose


def started(baseline: float, baseline_noise: float = 2e-4) -> InertialTracker:
    """Return the tracker of a camera with depth, or of a stereo rig, whose body is the camera."""
    camera = CameraAnnouncement(
        stamp=0,
        source="drone/camera",
        images=("grey", "depth"),
        info=INFO,
        rate=20.0,
        latency=0.0,
        frame_id="camera",
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
    )
    stereo = StereoSettings(baseline_noise=baseline_noise)
    return InertialTracker(camera, IMU, baseline, FeatureSettings(), InertialSettings(), stereo)


def test_the_covariance_has_the_uncertainty_of_the_baseline_along_the_way() -> None:
    def fly(noise: float) -> TrackingResult:
        tracker = started(BASELINE, noise)
        for number in range(6):
            time = number / 20
            felt = [[(time - 0.05 + k / 200) * 1e9, 0, 0, 0, 0, 0, -9.81] for k in range(1, 11)]
            left, right, _ = pair(pose(x=0.4 * time))
            result = tracker.fuse(int(time * 1e9), left, right, np.array(felt))
        return result

    known, unsure = fly(0.0), fly(0.3 * BASELINE)
    assert known.covariance is not None
    assert unsure.covariance is not None
    assert np.array_equal(known.pose, unsure.pose)
    way = 0.3 * unsure.pose[:3, 3]
    added = unsure.covariance - known.covariance
    assert np.linalg.norm(way) > 0.02
    assert np.allclose(added[:3, :3], np.outer(way, way), atol=1e-9)
    assert np.allclose(added[3:], 0.0, atol=1e-12)


def test_images_that_contradict_the_imu_are_lost_and_begin_a_frame_of_their_own() -> None:
    tracker, results = started(0.0), list[TrackingResult]()
    for number in range(40):
        time = number / 20
        rest = [[(time - 0.05 + k / 200) * 1e9, 0, 0, 0, 0, 0, -9.81] for k in range(1, 11)]
        # From 1 s on, the camera speeds up by 3 m/s², of which the IMU feels nothing.
        image, depth = look(pose(x=1.5 * max(time - 1.0, 0.0) ** 2))
        results.append(tracker.fuse(int(time * 1e9), image, depth, np.array(rest)))
    assert not any(result.lost or result.map for result in results[:20])
    assert any(result.lost for result in results[20:35])
    assert results[-1].map > 0


@pytest.mark.slow
def test_a_stereo_rig_that_comes_to_see_level_edges_only_is_lost_and_not_wrong() -> None:
    tracker, random = started(BASELINE), np.random.default_rng(1)
    texture, stripes = pair(pose())[:2], np.full((INFO.height, INFO.width), 110.0)
    stripes[40:90], stripes[150:170] = 60.0, 200.0
    lost = []
    for number in range(100):
        time = number / 20
        # From 1 s on, it speeds up to the right, along the stripes.
        ahead = 0.3 * (time > 1.025)
        felt = [[(time - 0.05 + k / 200) * 1e9, 0, 0, 0, ahead, 0, -9.81] for k in range(1, 11)]
        left, right = texture
        if time > 1.0:
            drawn = stripes + random.normal(0.0, 2.0, (2, *stripes.shape))
            left, right = drawn.clip(0, 255).astype(np.uint8)
        result = tracker.fuse(int(time * 1e9), left, right, np.array(felt))
        lost.append(result.lost)
        if not result.lost and result.covariance is not None:
            error = result.pose[:3, 3] - (0.15 * max(time - 1.0, 0.0) ** 2, 0.0, 0.0)
            spread = np.sqrt(np.diag(result.covariance)[:3]) + 0.005
            assert (np.abs(error) < 3.0 * spread).all(), (time, error, spread)
    assert not any(lost[:20])
    assert all(lost[-15:])
