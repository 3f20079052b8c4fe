"""A scripted flight on the vehicle's true pose."""

from __future__ import annotations

from events import Odometry, PositionSetpoint
from nodes.pilots.pilot import Pilot, PilotConfig
from nodes.pilots.waypoint_path import WaypointPath
from runtime import Output, on


class WaypointFollower(Pilot[PilotConfig]):
    """Flies a vehicle along waypoints, its nose in the direction of flight.

    It takes off, follows the path, lands, and ends the run.
    """

    setpoints = Output(PositionSetpoint)

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Note the vehicle's pose."""
        self.update_pose(event)

    async def follow(self, path: WaypointPath) -> None:
        """Send a position set-point for every step of the path."""
        start = self.clock.now()
        rows = zip(
            path.position.tolist(),
            path.velocity.tolist(),
            path.acceleration.tolist(),
            path.yaw.tolist(),
            path.yaw_rate.tolist(),
            strict=True,
        )
        for index, (position, velocity, acceleration, yaw, yaw_rate) in enumerate(rows):
            await self.clock.sleep_until(start + round(index * path.step * 1e9))
            self.setpoints.send(
                PositionSetpoint(
                    stamp=self.clock.now(),
                    source=self.name,
                    vehicle=self.config.vehicle,
                    position=tuple(position),
                    velocity=tuple(velocity),
                    acceleration=tuple(acceleration),
                    yaw=yaw,
                    yaw_rate=yaw_rate,
                )
            )
