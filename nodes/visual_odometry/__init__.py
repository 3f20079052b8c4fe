"""Where an RGB-D camera has gone, from its pictures: by features, or by all pixels."""

from nodes.visual_odometry.node import VisualOdometry, VisualOdometryConfig

__all__ = ["VisualOdometry", "VisualOdometryConfig"]
