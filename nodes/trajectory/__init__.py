"""Trajectories: poses in time, the files they come in, and exports for other tools."""

from nodes.trajectory.trajectory import PoseRows, Trajectory

__all__ = ["PoseRows", "Trajectory"]
