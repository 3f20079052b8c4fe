"""Example of an RGB-D estimator: corners, optical flow, and the camera's pose from both."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from nodes.estimators import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    RgbdFrame,
    TrackingResult,
)
from runtime import Bundle


class FlowOdometry:
    """Adds up the motion from each image to the next."""

    def __init__(self, matrix: Any, corners: int) -> None:
        self.matrix, self.corners = matrix, corners
        self.pose, self.before = np.eye(4), (None, None)

    def track(self, image: Any, depth: Any) -> TrackingResult:
        """Return where the camera is; image uint8 (h, w) or (h, w, 3), depth metres (h, w)."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        (last, last_depth), self.before = self.before, (grey, depth)
        if last is None:
            return TrackingResult(pose=self.pose)
        corners = cv2.goodFeaturesToTrack(last, self.corners, 0.01, 8)
        if corners is None:
            return TrackingResult(pose=self.pose, lost=True, reason="no corners")
        corners = corners.reshape(-1, 1, 2)
        points, status, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, None)
        pixels, points = corners[:, 0], points.reshape(-1, 2)
        z = last_depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        seen = (status[:, 0] == 1) & np.isfinite(z) & (z > 0)
        pixels, points, z = pixels[seen], points[seen], z[seen]
        rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(self.matrix).T
        inliers, solved = np.zeros(len(points), bool), False
        if len(points) >= 8:
            solved, turn, shift, which = cv2.solvePnPRansac(
                rays * z[:, None], points.astype(float), self.matrix, None, reprojectionError=1.5
            )
        if solved and which is not None:
            inliers[which.ravel()] = True
            motion = np.eye(4)  # from the last camera to this one
            motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            self.pose = self.pose @ np.linalg.inv(motion)
        return TrackingResult(
            pose=self.pose,
            lost=not solved,
            reason="too few corners",
            points=points,
            inliers=inliers,
        )


class OwnConfig(EstimatorConfig):
    """Settings.

    Attributes:
        corners: How many are tracked at most.
    """

    corners: int = 300


class OwnEstimator(Estimator[OwnConfig]):
    """Tracks a camera with depth; base class and evaluation do the rest.

    It reads pinhole images: as `lenses` names no model, those of a lens are rectified first.
    """

    needs = frozenset({"grey", "depth"})
    method = "optical flow and PnP"
    frames = Bundle(RgbdFrame, keep="latest")

    async def on_ready(self) -> None:
        """Start the tracker in a process of its own, with the announced calibration."""
        self.tracker = await self.worker(
            FlowOdometry,
            self.the_camera().info.matrix(),
            self.config.corners,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each image; skip images arriving meanwhile."""
        async for image, depth in self.frames:
            result = await self.tracker.call(FlowOdometry.track, image.data, depth.data)
            self.publish(image, result)
