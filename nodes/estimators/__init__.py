"""Estimators: the base classes of nodes that estimate poses from images, or from lidar scans."""

from nodes.estimators.estimator import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
)
from nodes.estimators.frames import (
    MonocularFrame,
    MonocularInertialFrame,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
    sample_rows,
)
from nodes.estimators.lidar import LidarEstimator
from nodes.estimators.mount import Mount
from nodes.estimators.result import TrackingResult

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
