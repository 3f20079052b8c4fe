"""Estimators: the base class of nodes that estimate poses from images."""

from nodes.estimation.estimator import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
)
from nodes.estimation.mount import Mount
from nodes.estimation.result import TrackingResult

__all__ = [
    "WORKER_ENVIRONMENT",
    "Estimator",
    "EstimatorConfig",
    "Mount",
    "RgbdFrame",
    "RgbdInertialFrame",
    "StereoFrame",
    "StereoInertialFrame",
    "TrackingResult",
]
