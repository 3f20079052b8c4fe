"""What the sensors of one vehicle sent, and its true motion, for the proof."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Quaternion,
    TakenOff,
    Vector3,
    VehicleEvent,
)
from nodes.calibration.room import NEAREST
from runtime import Node, on

_SAMPLES = 1500
"""Pixels of a depth image that are kept."""


class _Collector(Node):
    """Keeps what sensors send, in memory, images in grey; no node to be listed for a file."""

    reads_truth = "judging"

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


Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]


class Motion:
    """The true motion of a body: cubic between odometry's rows, with their twists.

    Args:
        rows: Of one body, two or more, in order.
    """

    def __init__(self, rows: Sequence[Odometry]) -> None:
        self.stamps: Stamps = np.array([row.stamp for row in rows], np.int64)
        self.rotations = Rotation.from_quat([row.orientation for row in rows], scalar_first=True)
        self.positions: Floats = np.array([row.position for row in rows])
        self.velocities = self.rotations.apply([row.linear_velocity for row in rows])
        self.rates: Floats = np.array([row.angular_velocity for row in rows])
        seconds = (self.stamps - self.stamps[0]) / 1e9
        self._place = CubicHermiteSpline(seconds, self.positions, self.velocities)

    def at(self, stamps: Stamps) -> tuple[Floats, Rotation]:
        """Return positions (metres, shape (n, 3)) and rotations to the parent frame at some times.

        Args:
            stamps: Nanoseconds, shape (n,), within those of the rows.
        """
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self.stamps) - 1)
        before = after - 1
        length = ((self.stamps[after] - self.stamps[before]) / 1e9)[:, None]
        share = ((stamps - self.stamps[before]) / 1e9)[:, None] / length
        base = self.rotations[before]
        whole = (base.inv() * self.rotations[after]).as_rotvec()
        first, last = self.rates[before] * length, self.rates[after] * length
        last = last + 0.5 * np.cross(whole, last)  # as the rotation vector changes there
        vector = (
            (share**3 - 2 * share**2 + share) * first
            + (3 * share**2 - 2 * share**3) * whole
            + (share**3 - share**2) * last
        )
        seconds = (stamps - self.stamps[0]) / 1e9
        return np.asarray(self._place(seconds)), base * Rotation.from_rotvec(vector)

    def mounted(
        self, stamps: Stamps, position: Vector3, orientation: Quaternion
    ) -> tuple[Floats, Rotation]:
        """Return the same of what is mounted on the body, at a pose in its frame."""
        place, turn = self.at(stamps)
        return place + turn.apply(position), turn * Rotation.from_quat(
            orientation, scalar_first=True
        )

    def rows_of(self, camera: CameraAnnouncement, stamp: int) -> tuple[Floats, Rotation]:
        """Return a camera's pose at each of its rows, of an image with a stamp."""
        height = camera.info.height
        share = np.arange(height) / max(height - 1, 1) - 0.5
        times = np.asarray(stamp - camera.time_offset * 1e9 + camera.readout * 1e9 * share)
        rounded = np.clip(np.rint(times).astype(np.int64), self.stamps[0], self.stamps[-1])
        return self.mounted(rounded, camera.position, camera.orientation)
