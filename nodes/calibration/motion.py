"""Where a body and its cameras truly were at any time, from its odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, Odometry, Quaternion, Vector3

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
