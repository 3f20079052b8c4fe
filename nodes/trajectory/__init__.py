"""Trajectories: poses in time, the files they come in, and exports for other tools."""

from nodes.trajectory.trajectory import PoseRows, RecentPoses, Trajectory, associate

__all__ = ["PoseRows", "RecentPoses", "Trajectory", "associate"]
