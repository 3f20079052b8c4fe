"""RGB-D visual odometry as a node: the images it reads, and the method that it runs."""

from __future__ import annotations

from typing import Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.estimators import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    RgbdFrame,
    TrackingResult,
)
from nodes.estimators.odometry.images import Depth
from nodes.estimators.visual_odometry.dense import DenseSettings, DenseTracker
from nodes.estimators.visual_odometry.features import FeatureTracker
from nodes.estimators.visual_odometry.settings import FeatureSettings
from runtime import Bundle


class Tracker(Protocol):
    """A method of RGB-D odometry."""

    def track(self, stamp: int, image: npt.NDArray[np.uint8], depth: Depth) -> TrackingResult:
        """Return the pose of the next image.

        Args:
            stamp: Stamp of the exposure (ns).
            image: Shape (h, w, 3) red, green, blue, or (h, w) grey.
            depth: Metres along the optical axis, shape (h, w); ``inf`` where nothing was measured.

        Raises:
            ValueError: The size is not that of the camera.
        """


class VisualOdometryConfig(EstimatorConfig):
    """Settings of visual odometry.

    Attributes:
        method: ``features``: corners, followed by optical flow, and their depth; ``dense``: every
            pixel, by OpenCV's ``cv2.Odometry``, as an example: it does not know when it is wrong.
        features: Settings of the method ``features``.
        dense: Settings of the method ``dense``.
    """

    method: Literal["features", "dense"] = "features"
    features: FeatureSettings = FeatureSettings()
    dense: DenseSettings = DenseSettings()


class VisualOdometry(Estimator[VisualOdometryConfig]):
    """Estimates the pose of a camera with depth from its images alone."""

    needs = frozenset({"grey", "depth"})
    lenses = frozenset()

    frames = Bundle(RgbdFrame, keep="latest")

    def __init__(self) -> None:
        example = ", an example" if self.config.method == "dense" else ""
        self.method = f"RGB-D odometry ({self.config.method}{example})"

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
        """Track each image; those that arrive meanwhile are skipped."""
        async for image, depth in self.frames:
            self.publish(
                image, await self._tracker.call(Tracker.track, image.stamp, image.data, depth.data)
            )


def make_tracker(config: VisualOdometryConfig, info: CameraInfo) -> Tracker:
    """Make the tracker that the settings ask for, in the process that will run it."""
    cv2.setNumThreads(1)
    if config.method == "dense":
        return DenseTracker(info, config.dense)
    return FeatureTracker(info, config.features)
