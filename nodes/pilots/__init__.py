"""Pilots: nodes that tell a vehicle where to fly.

`WaypointFollower` flies along waypoints by the vehicle's true pose, `VisualPilot` by the pose that
an estimator gives, and `Teleop` as the keys of a keyboard say.
"""

from nodes.pilots.pilot import Pilot, PilotConfig
from nodes.pilots.teleop import Keys, Teleop, TeleopConfig
from nodes.pilots.visual_pilot import VisualPilot, VisualPilotConfig
from nodes.pilots.waypoint_follower import WaypointFollower

__all__ = [
    "Keys",
    "Pilot",
    "PilotConfig",
    "Teleop",
    "TeleopConfig",
    "VisualPilot",
    "VisualPilotConfig",
    "WaypointFollower",
]
