"""What a run says of one vehicle: where it truly was, where it was meant to be, what it hit."""

from __future__ import annotations

from collections.abc import Sequence

from events import Collision, Odometry, PlannedPose, PositionSetpoint
from events.rotations import from_yaw
from nodes.judging.evaluation.judging import beside_the_plan
from nodes.trajectory import PoseRows, RecentPoses, Trajectory


class Flight:
    """The flight of one vehicle, as far as it has gone.

    Attributes:
        truth: Its true poses.
        recent: The last of them.
        body: Frame of its body.
        collisions: In the order in which they came.
    """

    def __init__(self) -> None:
        self.truth = PoseRows()
        self.recent = RecentPoses()
        self.body = "base_link"
        self.collisions: list[Collision] = []
        self._plan = PoseRows()
        self._setpoints = PoseRows()

    def add(self, event: Odometry) -> None:
        """Note where it is."""
        self.body = event.child_frame_id
        self.truth.add(event.stamp, event.position, event.orientation)
        self.recent.add(event.stamp, event.position, event.orientation)

    def add_plan(self, event: PlannedPose | PositionSetpoint) -> None:
        """Note where its pilot means it to be."""
        rows = self._plan if isinstance(event, PlannedPose) else self._setpoints
        rows.add(event.stamp, event.position, from_yaw(event.yaw))

    def plan(self) -> Trajectory | None:
        """Return where it was meant to be: by planned poses, or else by set-points."""
        rows = self._plan if len(self._plan) else self._setpoints
        return rows.trajectory() if len(rows) else None

    def figures(self, truth: Trajectory | None) -> dict[str, float]:
        """Return how often it hit something, and how far it was from its planned poses."""
        found: dict[str, float] = {"collisions": len(self.collisions)}
        if truth is not None and len(self._plan):
            found |= beside_the_plan(truth, self._plan.trajectory())
        return found


def collision_rows(collisions: Sequence[Collision]) -> str:
    """Return collisions as a CSV file."""
    rows = [
        f"{c.stamp},{c.source},{c.other},{','.join(f'{p:.3f}' for p in c.position)},{c.speed:.3f}\n"
        for c in collisions
    ]
    return "".join(["stamp_ns,vehicle,other,north_m,east_m,down_m,speed_m_s\n", *rows])
