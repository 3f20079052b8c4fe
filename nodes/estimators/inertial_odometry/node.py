"""Visual-inertial odometry nodes: for a camera with depth, and for a stereo rig."""

from __future__ import annotations

from events import DepthImage, Image, Imu
from nodes.estimators import (
    Estimator,
    EstimatorConfig,
    RgbdInertialFrame,
    StereoInertialFrame,
    sample_rows,
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
        apart = baseline(*self.cameras) if self.eyes == 2 else 0.0
        settings = config.features, config.inertial, config.stereo
        self._tracker = await self.start_tracker(
            InertialTracker, camera, self.imu_announcement, apart, *settings
        )

    async def fuse(self, image: Image, other: Image | DepthImage, imu: tuple[Imu, ...]) -> None:
        """Track an image and publish the result."""
        result = await self._tracker.call(
            InertialTracker.fuse, self.exposed_at(image), image.data, other.data, sample_rows(imu)
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
