"""A node that notes the stamp and the arrival of all that a vehicle's sensors say."""

from __future__ import annotations

from collections import defaultdict
from typing import ClassVar

from events import Collision, DepthImage, Event, Image, Imu, Odometry, PoseStamped
from runtime import Node, on


class Witness(Node):
    """Keeps (stamp, arrival) by the type of event."""

    seen: ClassVar[defaultdict[str, list[tuple[int, int]]]] = defaultdict(list)

    async def on_startup(self) -> None:
        self.seen.clear()

    @on(Image, DepthImage, PoseStamped, Imu, Odometry, Collision)
    def note(self, event: Event) -> None:
        self.seen[type(event).__name__].append((event.stamp, self.clock.now()))
