"""Stereo odometry as a node: the pair that it reads, and its tracker."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo
from events.poses import inverse, pose_matrix
from nodes.estimation import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    StereoFrame,
    TrackingResult,
)
from nodes.stereo_odometry.matcher import StereoMatcher, StereoSettings
from nodes.visual_odometry.features import FeatureTracker
from nodes.visual_odometry.settings import FeatureSettings
from runtime import Bundle

_TOLERANCE = 1e-3
"""Metres along y and z, and radians, by which a pair may differ from a rectified one."""


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

    def check(self) -> Iterable[str]:
        """Return the errors: no stereo rig, or one that is not rectified."""
        yield from super().check()
        if why_not := why_not_rectified(self.cameras):
            yield why_not

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
    """Return the metres from the left camera to the right one along its x axis."""
    return float(_between(left, right)[0, 3])


def why_not_rectified(cameras: tuple[CameraAnnouncement, ...]) -> str:
    """Return why the rows of two cameras do not match, in a sentence; empty if they do."""
    if len(cameras) != 2:
        return ""
    left, right = cameras
    a, b = left.info, right.info
    if (a.width, a.height, *a.matrix().ravel()) != (b.width, b.height, *b.matrix().ravel()):
        return (
            f"expected the same intrinsics of {left.source} and {right.source}, found {a} and {b}"
        )
    pose = _between(left, right)
    turned, off = np.abs(pose[:3, :3] - np.eye(3)).max(), np.abs(pose[1:3, 3]).max()
    if pose[0, 3] <= 0 or max(turned, off) > _TOLERANCE:
        x, y, z = pose[:3, 3]
        return (
            f"expected {right.source} to look the same way as {left.source}, to the right of it "
            f"(rectified images), found it at ({x:.4f}, {y:.4f}, {z:.4f}) m, turned by "
            f"{np.degrees(turned):.2f}°"
        )
    return ""


def _between(left: CameraAnnouncement, right: CameraAnnouncement) -> npt.NDArray[np.float64]:
    """Return the right camera's pose in the left one, shape (4, 4)."""
    return np.asarray(
        inverse(pose_matrix(left.position, left.orientation))
        @ pose_matrix(right.position, right.orientation)
    )
