"""Visual odometry of an RGB-D camera: by features, or by all pixels."""

from nodes.estimators.visual_odometry.node import VisualOdometry, VisualOdometryConfig

__all__ = ["VisualOdometry", "VisualOdometryConfig"]
