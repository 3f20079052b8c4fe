"""Estimators: base classes of nodes estimating poses from images or lidar scans."""

from nodes.estimators.estimator import WORKER_ENVIRONMENT, Estimator, EstimatorConfig
from nodes.estimators.rig import (
    MonocularFrame,
    MonocularInertialFrame,
    Mount,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
    TrackingResult,
    sample_rows,
)

__all__ = [
    "WORKER_ENVIRONMENT",
    "Estimator",
    "EstimatorConfig",
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
