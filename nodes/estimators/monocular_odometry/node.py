"""Monocular odometry as a node: the images it reads, and the estimates it sends."""

from __future__ import annotations

import cv2

from events import CameraInfo
from nodes.estimators import WORKER_ENVIRONMENT, Estimator, EstimatorConfig, MonocularFrame
from nodes.estimators.monocular_odometry.geometry import MonocularSettings
from nodes.estimators.monocular_odometry.tracker import MonocularTracker
from runtime import Bundle


class MonocularOdometryConfig(EstimatorConfig):
    """Settings of monocular odometry.

    Attributes:
        tracker: Settings of the tracker.
    """

    tracker: MonocularSettings = MonocularSettings()


class MonocularOdometry(Estimator[MonocularOdometryConfig]):
    """Estimates the pose of a single camera, in a unit of length of its own."""

    needs = frozenset({"grey"})
    lenses = frozenset()
    method = "monocular odometry"
    scale_free = True

    frames = Bundle(MonocularFrame, keep="latest")

    async def on_ready(self) -> None:
        """Start the tracker, in a process of its own."""
        self._tracker = await self.worker(
            make_tracker,
            self.the_camera().info,
            self.config.tracker,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each image; nothing is sent until there is a map."""
        async for (image,) in self.frames:
            result = await self._tracker.call(MonocularTracker.track, image.stamp, image.data)
            if result is not None:
                self.publish(image, result)


def make_tracker(info: CameraInfo, settings: MonocularSettings) -> MonocularTracker:
    """Make the tracker in the process that will run it."""
    cv2.setNumThreads(1)
    return MonocularTracker(info, settings)
