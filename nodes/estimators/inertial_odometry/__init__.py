"""Visual-inertial odometry: a camera with depth, or a stereo rig, and an IMU, tightly coupled."""

from nodes.estimators.inertial_odometry.tracker import (
    InertialOdometryConfig,
    RgbdInertialOdometry,
    StereoInertialOdometry,
)

__all__ = ["InertialOdometryConfig", "RgbdInertialOdometry", "StereoInertialOdometry"]
