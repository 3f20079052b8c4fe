"""Where a single camera has gone: sparse, semi-direct, with local bundle adjustment.

`odometry` is the whole, `beginning` its first map and `local_map` how that grows; `tracks` and
`flow` are the corners, `views` and `bundle` the geometry, `node` the node.
"""

from nodes.monocular_odometry.node import MonocularOdometry, MonocularOdometryConfig

__all__ = ["MonocularOdometry", "MonocularOdometryConfig"]
