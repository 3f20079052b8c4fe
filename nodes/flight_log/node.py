"""The node that writes down a flight, and draws it when it is over.

After a restart the trajectory goes on in the same file; plot and sheet get a number (``flight-2``)
and show what came after it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np

from events import Collision, Image, Odometry
from nodes.flight_log.drawing import Thumbnail, draw_contact_sheet, draw_flight
from nodes.trajectory import PoseRows
from nodes.trajectory.formats import tum_row
from nodes.trajectory.growing import GrowingFile, part_name
from runtime import Duration, Node, NodeConfig, on
from runtime.paths import OutputPath

Count = Annotated[int, msgspec.Meta(ge=1, le=100)]


_WIDTH = 256
"""Pixels of a small image."""


class FlightLogConfig(NodeConfig):
    """Settings of the flight log.

    Attributes:
        trajectory: File for the trajectory, in the run's folder.
        plot: File for the plot of the flight.
        sheet: File for the sheet of images.
        interval: Seconds between two images on the sheet; doubled whenever it is full.
        image_count: How many images it holds.
    """

    trajectory: OutputPath = "trajectory.tum"
    plot: OutputPath = "flight.png"
    sheet: OutputPath = "images.png"
    interval: Duration = Duration(1)  # immutable
    image_count: Count = 20


class FlightLog(Node[FlightLogConfig]):
    """Writes the ground truth as a TUM trajectory, and draws the flight when it is over."""

    async def on_startup(self) -> None:
        """Open the trajectory: it grows as the vehicle flies."""
        self._poses = PoseRows()
        self._thumbnails: list[Thumbnail] = []
        self._collisions: list[Collision] = []
        self._interval = round(self.config.interval * 1e9)
        self._next_image: dict[str, int] = {}  # by camera
        self._file: GrowingFile | None = None
        if self.out is not None:
            head = "# timestamp[s] x y z[m, NED] qx qy qz qw (FRD to NED)\n"
            self._file = GrowingFile(self, self.out / self.config.trajectory, head)

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Note where the vehicle is."""
        if self._file is not None:
            self._file.add(tum_row(event.stamp, event.position, event.orientation))
            self._poses.add(event.stamp, event.position, event.orientation)

    @on(Image)
    def images(self, event: Image) -> None:
        """Keep a small copy of an image at intervals."""
        if event.stamp < self._next_image.get(event.source, 0):
            return
        self._next_image[event.source] = event.stamp + self._interval
        height, width = event.data.shape[:2]
        scale = _WIDTH / width
        size = (_WIDTH, max(round(height * scale), 1))
        small = cv2.resize(event.data, size, interpolation=cv2.INTER_AREA)
        self._thumbnails.append((event.stamp, event.source, np.atleast_3d(small)))
        if len(self._thumbnails) > self.config.image_count:
            self._interval *= 2
            kept = (t for t in self._thumbnails if t[0] % self._interval < self._interval // 2)
            self._thumbnails = list(kept)

    @on(Collision)
    def collisions(self, event: Collision) -> None:
        """Note a collision."""
        self._collisions.append(event)

    async def on_shutdown(self) -> None:
        """Close the trajectory and draw the plot and the sheet."""
        if self._file is None or self.out is None:
            return
        self._file.close()
        plot = self.out / part_name(self, self.config.plot)
        if len(self._poses):
            await self.offload(self._draw, plot)
        if self._thumbnails:
            sheet = self.out / part_name(self, self.config.sheet)
            await self.offload(draw_contact_sheet, self._thumbnails, sheet)

    def _draw(self, plot: Path) -> None:
        places = [(c.position[0], c.position[1]) for c in self._collisions]
        draw_flight(self._poses.trajectory(), places, plot)
