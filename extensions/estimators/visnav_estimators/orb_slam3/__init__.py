"""ORB-SLAM3 as an estimator: an extra, since under the GPL."""

from visnav_estimators.orb_slam3.node import OrbSlam3, OrbSlam3Config

__all__ = ["OrbSlam3", "OrbSlam3Config"]
