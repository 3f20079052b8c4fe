"""Pilots: nodes to fly a vehicle, by set-points and commands."""

from nodes.pilots.pilot import Pilot, PilotConfig, VisualPilot, VisualPilotConfig, WaypointFollower
from nodes.pilots.teleop import Keys, Teleop, TeleopConfig
from nodes.pilots.waypoint_path import Excitation, FigureEight

__all__ = [
    "Excitation",
    "FigureEight",
    "Keys",
    "Pilot",
    "PilotConfig",
    "Teleop",
    "TeleopConfig",
    "VisualPilot",
    "VisualPilotConfig",
    "WaypointFollower",
]
