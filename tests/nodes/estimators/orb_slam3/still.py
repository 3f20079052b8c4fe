"""A node with a camera that sees one image, again and again."""

from __future__ import annotations

from events import Image
from runtime import Node, Output, Tick, every
from tests.nodes.estimators.orb_slam3.scene import views


class Still(Node):
    """Sends the same image ten times a second."""

    images = Output(Image)

    def __init__(self) -> None:
        self._image = views(1)[0].rgb

    @every(hz=10)
    def show(self, tick: Tick) -> None:
        """Send it."""
        self.images.send(
            Image(stamp=tick.stamp, source=f"{self.name}/front", frame_id="f", data=self._image)
        )
