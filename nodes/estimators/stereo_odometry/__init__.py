"""Odometry of a stereo rig: depth of corners from the right image, then the tracker of RGB-D."""

from nodes.estimators.stereo_odometry.matcher import StereoMatcher, StereoSettings
from nodes.estimators.stereo_odometry.node import (
    StereoOdometry,
    StereoOdometryConfig,
    baseline,
)

__all__ = [
    "StereoMatcher",
    "StereoOdometry",
    "StereoOdometryConfig",
    "StereoSettings",
    "baseline",
]
