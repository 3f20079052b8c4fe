"""Visual-inertial odometry nodes: for a camera with depth, and for a stereo rig."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events import DepthImage, Image, Imu
from nodes.estimators import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    RgbdInertialFrame,
    StereoInertialFrame,
)
from nodes.estimators.inertial_odometry.tracker import InertialSettings, InertialTracker
from nodes.estimators.visual_odometry.stereo import StereoSettings, baseline
from nodes.estimators.visual_odometry.surfaces import FeatureSettings
from runtime import Bundle


class InertialOdometryConfig(EstimatorConfig):
    """Settings of visual-inertial odometry; the IMU's noise is as announced.

    Attributes:
        inertial: Settings of the fusion with the IMU.
        features: Settings of the map; of a stereo rig, its ``depth_noise`` is that of the matching.
        stereo: Settings of the matching of a stereo rig's images.
    """

    inertial: InertialSettings = InertialSettings()
    features: FeatureSettings = FeatureSettings()
    stereo: StereoSettings = StereoSettings()


class _InertialOdometry(Estimator[InertialOdometryConfig]):
    inertial = True
    lenses = frozenset()

    async def on_ready(self) -> None:
        """Start the tracker, in a process of its own."""
        camera, config = self.the_camera(), self.config
        if self.imu_announcement is None:
            self.log.fatal("%s", self._missing())
        self._tracker = await self.worker(
            InertialTracker,
            camera,
            self.imu_announcement,
            baseline(*self.cameras) if self.eyes == 2 else 0.0,
            config.features,
            config.inertial,
            config.stereo,
            latency=config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def fuse(self, image: Image, other: Image | DepthImage, imu: tuple[Imu, ...]) -> None:
        """Track an image and publish the result."""
        result = await self._tracker.call(
            InertialTracker.fuse, self.exposed_at(image), image.data, other.data, as_rows(imu)
        )
        self.publish(image, result)


class RgbdInertialOdometry(_InertialOdometry):
    """Estimates pose, velocity and covariance of a camera with depth and an IMU."""

    needs = frozenset({"grey", "depth"})
    method = "RGB-D-inertial odometry (filter)"

    frames = Bundle(RgbdInertialFrame, keep="latest")

    async def run(self) -> None:
        """Track each image; images arriving meanwhile are skipped, IMU samples are not."""
        async for image, depth, imu in self.frames:
            await self.fuse(image, depth, imu)


class StereoInertialOdometry(_InertialOdometry):
    """Estimates pose, velocity and covariance of a rectified stereo rig and an IMU."""

    needs = frozenset({"grey"})
    eyes = 2
    method = "stereo-inertial odometry (filter)"

    frames = Bundle(StereoInertialFrame, keep="latest")

    async def run(self) -> None:
        """Track each pair; pairs arriving meanwhile are skipped, IMU samples are not."""
        async for left, right, imu in self.frames:
            await self.fuse(left, right, imu)


def as_rows(imu: tuple[Imu, ...]) -> npt.NDArray[np.float64]:
    """Return samples as rows: stamp (ns), angular velocity, specific force; shape (n, 7)."""
    rows = [(each.stamp, *each.angular_velocity, *each.linear_acceleration) for each in imu]
    return np.array(rows, np.float64).reshape(-1, 7)
