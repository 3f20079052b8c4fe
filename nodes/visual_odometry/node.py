"""RGB-D visual odometry as a node: which camera it reads, and which method it runs beside."""

from __future__ import annotations

from typing import Literal

import cv2

from events import CameraInfo
from nodes.estimation import WORKER_ENVIRONMENT, Estimator, EstimatorConfig, RgbdFrame
from nodes.visual_odometry.dense import DenseOdometry, DenseSettings
from nodes.visual_odometry.features import FeatureOdometry, FeatureSettings
from nodes.visual_odometry.tracker import Tracker
from runtime import Bundle


class VisualOdometryConfig(EstimatorConfig):
    """Settings of visual odometry.

    Attributes:
        method: ``features``: corners, followed by optical flow, and their depth; ``dense``: every
            pixel, by OpenCV's ``cv2.Odometry``.
        features: Of the first method.
        dense: Of the second.
    """

    method: Literal["features", "dense"] = "features"
    features: FeatureSettings = FeatureSettings()
    dense: DenseSettings = DenseSettings()


class VisualOdometry(Estimator[VisualOdometryConfig]):
    """Where a camera with depth has gone, from its pictures alone."""

    needs = frozenset({"grey", "depth"})

    frames = Bundle(RgbdFrame, keep="latest")

    def __init__(self) -> None:
        self.method = f"RGB-D odometry ({self.config.method})"

    async def on_ready(self) -> None:
        """Start the tracker, in a process of its own."""
        self._tracker = await self.worker(
            make_tracker,
            self.config,
            self.the_camera().info,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each image; skip those that come meanwhile."""
        async for image, depth in self.frames:
            self.publish(
                image, await self._tracker.call(Tracker.track, image.stamp, image.data, depth.data)
            )


def make_tracker(config: VisualOdometryConfig, info: CameraInfo) -> Tracker:
    """Make the tracker that the settings ask for, in the process that will run it."""
    cv2.setNumThreads(1)
    if config.method == "dense":
        return DenseOdometry(info, config.dense)
    return FeatureOdometry(info, config.features)
