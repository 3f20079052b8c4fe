"""ORB-SLAM3 as an estimator: an extra, since under the GPL.

`settings` makes its settings from the announcements of sensors, `process` runs the library in a
worker, `vocabulary` and `training` make the bag of words that it needs, `node` is the node.
"""

from nodes.estimators.orb_slam3.node import OrbSlam3, OrbSlam3Config

__all__ = ["OrbSlam3", "OrbSlam3Config"]
