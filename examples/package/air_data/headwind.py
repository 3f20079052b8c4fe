"""A node that judges: how much of the speed through the air is wind."""

from air_data.airspeed import Airspeed
from events import Odometry, Score
from runtime import Node, Output, on


class Headwind(Node):
    """Scores the wind from ahead, by an airspeed sensor beside the true velocity."""

    reads_truth = "judging"
    scores = Output(Score)

    def __init__(self) -> None:
        self._ahead = 0.0

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Keep the velocity forward."""
        self._ahead = event.linear_velocity[0]

    @on(Airspeed)
    def airspeeds(self, event: Airspeed) -> None:
        """Score by how much the air is faster than the ground."""
        self.scores.send(
            Score(
                stamp=event.stamp,
                source=self.name,
                subject=event.source,
                metric="headwind",
                value=event.airspeed - self._ahead,
                unit="m/s",
            )
        )
