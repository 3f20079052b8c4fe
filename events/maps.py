"""Maps that nodes build."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from events.base import Category, Event
from events.checks import check
from events.sensors import publish


class PointCloud(Event, eq=False):
    """Points with colours, as ROS's ``sensor_msgs/PointCloud2`` would carry them.

    Attributes:
        frame_id: Frame of the points.
        points: float32 metres, shape (n, 3).
        colors: uint8 red, green, blue, shape (n, 3); shape (0, 3) if there are none.
    """

    category: ClassVar[Category] = Category.MAP

    frame_id: str = "map"
    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        check(self)
        publish("PointCloud", "points", self.points, np.float32, {2})
        publish("PointCloud", "colors", self.colors, np.uint8, {2})
