"""Estimators: the base class of nodes that estimate poses from images."""

from nodes.estimation.estimator import (
    WORKER_ENVIRONMENT,
    Estimator,
    EstimatorConfig,
    RgbdFrame,
    TrackingResult,
)
from nodes.estimation.mount import Mount

__all__ = [
    "WORKER_ENVIRONMENT",
    "Estimator",
    "EstimatorConfig",
    "Mount",
    "RgbdFrame",
    "TrackingResult",
]
