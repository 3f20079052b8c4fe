"""Visual odometry of a single camera: sparse, semi-direct, with local bundle adjustment.

`tracker` is the method and its node, `local_map` makes and extends the map, `geometry` is that of
several views.
"""

from nodes.estimators.monocular_odometry.tracker import MonocularOdometry, MonocularOdometryConfig

__all__ = ["MonocularOdometry", "MonocularOdometryConfig"]
