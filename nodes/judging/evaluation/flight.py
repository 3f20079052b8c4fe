"""Flight of a vehicle as it truly was, and figures of it beside its plan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from events import Collision, Odometry, PlannedPose, PositionSetpoint, Vector3
from events.frames import from_yaw
from nodes.judging.evaluation.metrics import position_errors, rms
from nodes.trajectory import PoseRows, RecentPoses, Trajectory


def beside_the_plan(truth: Trajectory, plan: Trajectory) -> dict[str, float]:
    """Return root mean square and maximum of distances from the plan, m; empty without overlap."""
    rows = np.flatnonzero(truth.covers(plan.stamps))
    if not len(rows):
        return {}
    true_poses = truth.at(plan.stamps[rows])
    distances = position_errors(true_poses.positions, plan.positions[rows])
    return {"plan_rmse_m": rms(distances), "plan_max_m": float(distances.max())}


class Flight:
    """Flight of a vehicle so far: its true poses, the last of them, and collisions in order."""

    def __init__(self) -> None:
        self.truth = PoseRows()
        self.recent = RecentPoses()
        self.path = 0.0  # length of the path, metres
        self._position: Vector3 | None = None
        self.body = "base_link"  # frame of its body
        self.collisions: list[Collision] = []
        self._plan = PoseRows()
        self._setpoints = PoseRows()

    def add(self, event: Odometry) -> None:
        """Add a true pose."""
        self.body = event.child_frame_id
        self.path += math.dist(self._position or event.position, event.position)
        self._position = event.position
        self.truth.add(event.stamp, event.position, event.orientation)
        self.recent.add(event.stamp, event.position, event.orientation)

    def add_plan(self, event: PlannedPose | PositionSetpoint) -> None:
        """Add a planned pose or a set-point."""
        rows = self._plan if isinstance(event, PlannedPose) else self._setpoints
        rows.add(event.stamp, event.position, from_yaw(event.yaw))

    def plan(self) -> Trajectory | None:
        """Return the planned path: from planned poses, or else from set-points."""
        rows = self._plan if len(self._plan) else self._setpoints
        return rows.trajectory() if len(rows) else None

    def figures(self, truth: Trajectory | None) -> dict[str, float]:
        """Return the number of collisions, and the distance from planned poses."""
        figures: dict[str, float] = {"collisions": len(self.collisions)}
        if truth is not None and len(self._plan):
            figures |= beside_the_plan(truth, self._plan.trajectory())
        return figures


def collision_rows(collisions: Sequence[Collision]) -> str:
    """Return collisions as a CSV file."""
    rows = [
        f"{c.stamp},{c.source},{c.other},{','.join(f'{p:.3f}' for p in c.position)},{c.speed:.3f}\n"
        for c in collisions
    ]
    return "".join(["stamp_ns,vehicle,other,north_m,east_m,down_m,speed_m_s\n", *rows])
