"""ORB-SLAM3 in the place of our own odometry: an extra, since it is under the GPL.

`settings` are generated from what sensors announce, `process` is the library in a worker,
`vocabulary` and `training` make the bag of words that it needs, `node` is the node.
"""

from nodes.orb_slam3.node import OrbSlam3, OrbSlam3Config

__all__ = ["OrbSlam3", "OrbSlam3Config"]
