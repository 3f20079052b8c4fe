"""Keeps what the sensors of one vehicle send, for the proof."""

from __future__ import annotations

from collections import defaultdict

import cv2
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    TakenOff,
    VehicleEvent,
)
from nodes.calibration.room import NEAREST
from runtime import Node, on

_SAMPLES = 1500
"""Pixels of a depth image that are kept."""


class _Collector(Node):
    """Keeps what sensors send, in memory, images in grey; no node to be listed for a file."""

    def __init__(self) -> None:
        self.cameras: dict[str, CameraAnnouncement] = {}
        self.imu_announced: ImuAnnouncement | None = None
        self.odometry: list[Odometry] = []
        self.imu: list[Imu] = []
        self.taken_off = 0
        self.images: dict[str, dict[int, npt.NDArray[np.uint8]]] = defaultdict(dict)
        self.poses: dict[str, dict[int, PoseStamped]] = defaultdict(dict)
        self.depths: dict[str, dict[int, npt.NDArray[np.float64]]] = defaultdict(dict)
        """Rows of column, row and depth (metres), by source and stamp."""
        self.own: dict[str, dict[int, npt.NDArray[np.bool_]]] = defaultdict(dict)
        """Where the vehicle itself is seen, by source and stamp."""

    def on_announcement(self, announcement: Announcement) -> None:
        """Note cameras and the IMU."""
        if isinstance(announcement, CameraAnnouncement):
            self.cameras[announcement.source] = announcement
        elif isinstance(announcement, ImuAnnouncement):
            self.imu_announced = announcement

    @on(Odometry)
    def note_odometry(self, event: Odometry) -> None:
        """Keep where the vehicle is."""
        self.odometry.append(event)

    @on(Imu)
    def note_imu(self, event: Imu) -> None:
        """Keep a measurement."""
        self.imu.append(event)

    @on(VehicleEvent)
    def note_vehicle(self, event: VehicleEvent) -> None:
        """Note when the vehicle flies."""
        if isinstance(event, TakenOff):
            self.taken_off = event.stamp

    @on(PoseStamped)
    def note_pose(self, event: PoseStamped) -> None:
        """Keep where a camera was."""
        self.poses[event.source][event.stamp] = event

    @on(Image)
    def note_image(self, event: Image) -> None:
        """Keep an image in grey."""
        grey = event.data if event.data.ndim == 2 else cv2.cvtColor(event.data, cv2.COLOR_RGB2GRAY)
        self.images[event.source][event.stamp] = np.asarray(grey, np.uint8)

    @on(DepthImage)
    def note_depth(self, event: DepthImage) -> None:
        """Keep some pixels of a depth image, the same of each, and where the vehicle is seen."""
        depth = event.data
        pixels = np.random.default_rng(0).integers(0, depth.size, _SAMPLES)
        rows, columns = np.divmod(pixels, depth.shape[1])
        self.depths[event.source][event.stamp] = np.column_stack(
            [columns, rows, depth[rows, columns]]
        ).astype(np.float64)
        self.own[event.source][event.stamp] = depth < NEAREST
