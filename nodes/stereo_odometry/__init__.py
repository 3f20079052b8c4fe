"""Odometry of a stereo rig: depth of corners from the right image, then the tracker of RGB-D."""

from nodes.stereo_odometry.matcher import StereoMatcher, StereoSettings
from nodes.stereo_odometry.node import (
    StereoOdometry,
    StereoOdometryConfig,
    baseline,
    why_not_rectified,
)

__all__ = [
    "StereoMatcher",
    "StereoOdometry",
    "StereoOdometryConfig",
    "StereoSettings",
    "baseline",
    "why_not_rectified",
]
