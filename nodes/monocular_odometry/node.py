"""Monocular odometry as a node: the images it reads, and the estimates it sends."""

from __future__ import annotations

from typing import NamedTuple

import cv2

from events import CameraInfo, Image
from nodes.estimation import WORKER_ENVIRONMENT, Estimator, EstimatorConfig
from nodes.monocular_odometry.odometry import MonocularOdometry as Odometry
from nodes.monocular_odometry.settings import MonocularSettings
from runtime import Bundle


class Frame(NamedTuple):
    """One image."""

    image: Image


class MonocularOdometryConfig(EstimatorConfig):
    """Settings of monocular odometry.

    Attributes:
        settings: Settings of the method.
    """

    settings: MonocularSettings = MonocularSettings()


class MonocularOdometry(Estimator[MonocularOdometryConfig]):
    """Estimates the pose of a single camera, in a unit of length of its own."""

    needs = frozenset({"grey"})
    method = "monocular odometry"
    scale_free = True

    frames = Bundle(Frame, keep="latest")

    async def on_ready(self) -> None:
        """Start the odometry, in a process of its own."""
        self._odometry = await self.worker(
            make_odometry,
            self.the_camera().info,
            self.config.settings,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each image; nothing is sent until there is a map."""
        async for (image,) in self.frames:
            result = await self._odometry.call(Odometry.track, image.stamp, image.data)
            if result is not None:
                self.publish(image, result)


def make_odometry(info: CameraInfo, settings: MonocularSettings) -> Odometry:
    """Make the odometry in the process that will run it."""
    cv2.setNumThreads(1)
    return Odometry(info, settings)
