"""Visual odometry of an RGB-D camera: by features, or by all pixels."""

from nodes.visual_odometry.node import VisualOdometry, VisualOdometryConfig

__all__ = ["VisualOdometry", "VisualOdometryConfig"]
