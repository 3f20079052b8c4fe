"""The tracker by the images of a small world, and an IMU that agrees with them or does not."""

from __future__ import annotations

import numpy as np

from events import CameraAnnouncement
from nodes.estimators import TrackingResult
from nodes.estimators.inertial_odometry.tracker import InertialSettings, InertialTracker
from nodes.estimators.stereo_odometry import StereoSettings
from nodes.estimators.visual_odometry.settings import FeatureSettings
from tests.nodes.estimators.inertial_odometry.test_preintegration import IMU
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose


def test_images_that_contradict_the_imu_are_lost_and_begin_a_frame_of_their_own() -> None:
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
    tracker = InertialTracker(
        camera, IMU, 0.0, FeatureSettings(), InertialSettings(), StereoSettings()
    )
    found: list[TrackingResult] = []
    for number in range(40):
        time = number / 20
        rest = [[(time - 0.05 + k / 200) * 1e9, 0, 0, 0, 0, 0, -9.81] for k in range(1, 11)]
        # From 1 s on, the camera speeds up by 3 m/s², of which the IMU feels nothing.
        image, depth = look(pose(x=1.5 * max(time - 1.0, 0.0) ** 2))
        found.append(tracker.fuse(int(time * 1e9), image, depth, np.array(rest)))
    assert not any(result.lost or result.map for result in found[:20])
    assert any(result.lost for result in found[20:35])
    assert found[-1].map > 0
