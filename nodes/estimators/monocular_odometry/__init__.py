"""Visual odometry of a single camera: sparse, semi-direct, with local bundle adjustment.

`tracker` is the method, `local_map` makes and extends its map, `geometry` is that of several views,
`node` the node.
"""

from nodes.estimators.monocular_odometry.node import MonocularOdometry, MonocularOdometryConfig

__all__ = ["MonocularOdometry", "MonocularOdometryConfig"]
