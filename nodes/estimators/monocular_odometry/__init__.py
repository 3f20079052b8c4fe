"""Visual odometry of a single camera: sparse, semi-direct, with local bundle adjustment.

`tracker` is the method, `initialization` makes its first map, `local_map` extends it and has the
corners, `keyframes` keeps images to relocalize by; `views` and `bundle` are the geometry, `node`
the node.
"""

from nodes.estimators.monocular_odometry.node import MonocularOdometry, MonocularOdometryConfig

__all__ = ["MonocularOdometry", "MonocularOdometryConfig"]
