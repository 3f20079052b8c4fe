"""A lidar whose x axis is down, and its scans."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import LidarAnnouncement, LidarScan

Floats = npt.NDArray[np.float64]
PERIOD = 100_000_000
DOWN = tuple(Rotation.from_euler("y", -90, degrees=True).as_quat(scalar_first=True).tolist())


def lidar(source: str = "drone/top") -> LidarAnnouncement:
    return LidarAnnouncement(
        stamp=0,
        source=source,
        rate=10.0,
        frame_id="top",
        position=(0.0, 0.0, -0.1),
        orientation=DOWN,  # its x is down
        channels=16,
        columns=64,
        horizontal_fov=6.28,
        elevations=(-0.3, 0.3),
        noise=0.0,
        min_range=0.5,
        max_range=50.0,
    )


def scan(
    number: int, points: Floats, source: str = "drone/top", span: float = 0.09375
) -> LidarScan:
    count = len(points)
    return LidarScan(
        stamp=number * PERIOD,
        source=source,
        frame_id="top",
        points=points.astype(np.float32),
        intensities=np.ones(count, np.float32),
        times=np.linspace(0.0, span, count, dtype=np.float32),
        rings=np.zeros(count, np.uint16),
    )
