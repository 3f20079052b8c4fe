"""Estimators: the base classes of nodes that estimate poses from images, or from lidar scans."""

from nodes.estimation.estimator import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
)
from nodes.estimation.frames import (
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
)
from nodes.estimation.lidar import LidarEstimator
from nodes.estimation.mount import Mount
from nodes.estimation.result import TrackingResult

__all__ = [
    "WORKER_ENVIRONMENT",
    "Estimator",
    "EstimatorConfig",
    "LidarEstimator",
    "Mount",
    "RgbdFrame",
    "RgbdInertialFrame",
    "StereoFrame",
    "StereoInertialFrame",
    "TrackingResult",
]
