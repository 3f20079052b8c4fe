"""Stereo odometry as a node: the pair that it reads, and its tracker."""

from __future__ import annotations

import math

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo
from nodes.estimators import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    StereoFrame,
    TrackingResult,
)
from nodes.estimators.stereo_odometry.matcher import StereoMatcher, StereoSettings
from nodes.estimators.visual_odometry.features import FeatureTracker
from nodes.estimators.visual_odometry.settings import FeatureSettings
from runtime import Bundle


class StereoOdometryConfig(EstimatorConfig):
    """Settings of stereo odometry.

    Attributes:
        stereo: Settings of the matching of both images.
        features: Settings of the tracker; its ``depth_noise`` is that of the matching.
    """

    stereo: StereoSettings = StereoSettings()
    features: FeatureSettings = FeatureSettings()


class StereoOdometry(Estimator[StereoOdometryConfig]):
    """Estimates the pose of the left camera of a rectified stereo rig from its images alone."""

    needs = frozenset({"grey"})
    eyes = 2
    lenses = frozenset()
    method = "stereo odometry (features)"

    frames = Bundle(StereoFrame, keep="latest")

    async def on_ready(self) -> None:
        """Start the tracker, in a process of its own."""
        left, right = self.the_camera(), self.cameras[1]
        self._tracker = await self.worker(
            StereoTracker,
            left.info,
            baseline(left, right),
            self.config.stereo,
            self.config.features,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each pair; those that arrive meanwhile are skipped."""
        async for left, right in self.frames:
            self.publish(
                left,
                await self._tracker.call(StereoTracker.track, left.stamp, left.data, right.data),
            )


class StereoTracker:
    """Tracks the left camera of a pair. Equal images give equal poses, to the bit.

    Args:
        info: Intrinsics of both cameras, which must be free of distortion.
        baseline: Metres from the left camera to the right one.
        stereo: Settings of the matching.
        features: Settings of the tracker.
    """

    def __init__(
        self, info: CameraInfo, baseline: float, stereo: StereoSettings, features: FeatureSettings
    ) -> None:
        cv2.setNumThreads(1)
        self._matcher = StereoMatcher(info, baseline, stereo)
        features = msgspec.structs.replace(features, depth_noise=self._matcher.depth_noise)
        self._tracker = FeatureTracker(info, features, self._matcher.surfaces_at)

    def track(
        self, stamp: int, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8]
    ) -> TrackingResult:
        """Return the pose of the left camera at the next pair; see `FeatureTracker.track`."""
        return self._tracker.track(stamp, left, self._matcher.depth(left, right))


def baseline(left: CameraAnnouncement, right: CameraAnnouncement) -> float:
    """Return the metres from the left camera to the right one, both aligned."""
    return math.dist(left.position, right.position)
