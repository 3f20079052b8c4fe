"""A node with work at 400 Hz, as a controller has it."""

from __future__ import annotations

from events import Image, Imu, Odometry
from runtime import Node, Tick, every, on


class Ticker(Node):
    """Does next to nothing, on time; ends the run if something comes before it has been."""

    @every(hz=400)
    def control(self, tick: Tick) -> None:
        """Be called."""

    @on(Image, Imu, Odometry)
    def measurements(self, event: Image | Imu | Odometry) -> None:
        """Look at the stamp."""
        if not 0 <= event.stamp <= self.clock.now():
            self.log.fatal("%s of %d ns at %d ns", event, event.stamp, self.clock.now())
