"""Visual odometry of a single camera: sparse, semi-direct, with local bundle adjustment."""

from nodes.estimators.monocular_odometry.tracker import MonocularOdometry, MonocularOdometryConfig

__all__ = ["MonocularOdometry", "MonocularOdometryConfig"]
