"""Visual-inertial odometry: a camera with depth, or a stereo rig, and an IMU, tightly coupled.

`preintegration` (what the IMU felt), `filter` (the state), `rolling_shutter` (its images),
`tracker` (all of it with the map of `nodes.estimators.visual_odometry`), `node`.
"""

from nodes.estimators.inertial_odometry.node import (
    InertialOdometryConfig,
    RgbdInertialOdometry,
    StereoInertialOdometry,
)

__all__ = ["InertialOdometryConfig", "RgbdInertialOdometry", "StereoInertialOdometry"]
