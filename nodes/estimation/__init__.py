"""Estimators: the base classes of nodes that estimate poses from images, or from lidar scans."""

from nodes.estimation.estimator import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
)
from nodes.estimation.frames import (
    MonocularFrame,
    MonocularInertialFrame,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
    sample_rows,
)
from nodes.estimation.lidar import LidarEstimator
from nodes.estimation.mount import Mount
from nodes.estimation.result import TrackingResult

__all__ = [
    "WORKER_ENVIRONMENT",
    "Estimator",
    "EstimatorConfig",
    "LidarEstimator",
    "MonocularFrame",
    "MonocularInertialFrame",
    "Mount",
    "RgbdFrame",
    "RgbdInertialFrame",
    "StereoFrame",
    "StereoInertialFrame",
    "TrackingResult",
    "sample_rows",
]
