"""KISS-ICP itself, by `kiss_icp`, for a worker's process.

    kiss = await self.worker(KissIcpProcess, lidar, settings, latency=…)
    result = await kiss.call(KissIcpProcess.track, scan.points, scan.times)

The library is imported when an object is made, so that others may import this module for its names.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events import LidarAnnouncement
from nodes.estimators import TrackingResult
from nodes.estimators.kiss_icp.settings import KissIcpSettings
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

INSTALL = install_command("kiss-icp")


class KissIcpProcess:
    """Registers each scan with a map of voxels.

    It computes in the frame of the points, whichever that is, with one thread: the sums of several
    would have no fixed order.

    Args:
        lidar: Whose ranges are the limits.
        settings: Settings of the method.

    Raises:
        MissingDependencyError: `kiss_icp` cannot be imported.
    """

    def __init__(self, lidar: LidarAnnouncement, settings: KissIcpSettings) -> None:
        try:
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        except ImportError as error:
            raise MissingDependencyError(f"KISS-ICP needs kiss_icp ({error}): {INSTALL}") from error
        reach = settings.max_range or lidar.max_range
        # All is given: what is not, it would read from the environment.
        config = KISSConfig(
            data={"max_range": reach, "min_range": lidar.min_range, "deskew": settings.deskew},
            mapping={
                "voxel_size": settings.voxel_size or reach / 100,
                "max_points_per_voxel": settings.max_points_per_voxel,
            },
            registration={"max_num_threads": 1},
            adaptive_threshold={
                "initial_threshold": settings.initial_threshold,
                "min_motion_th": settings.min_motion,
            },
        )
        self._odometry = KissICP(config)
        self._limits = lidar.min_range, reach
        self._min_points = settings.min_points

    def track(
        self, points: npt.NDArray[np.float32], times: npt.NDArray[np.float32]
    ) -> TrackingResult:
        """Return the pose of the lidar at the last ray of the next scan.

        It is in the lidar's frame at the last ray of the first scan with enough points.

        Args:
            points: Each in the lidar's frame at the time of its ray, metres, shape (n, 3).
            times: Of the rays, seconds, shape (n,).
        """
        near, far = self._limits
        distances = np.linalg.norm(points, axis=1)
        usable = (distances > near) & (distances < far)  # and so no NaN
        found = int(usable.sum())
        before = self._odometry.last_pose, self._odometry.last_delta
        if found < self._min_points:
            reason = f"{found} points, expected {self._min_points}"
            return TrackingResult(pose=before[0], lost=True, reason=reason)
        stamps = times[usable].astype(np.float64)
        if np.ptp(stamps) == 0.0:
            stamps = stamps[:0]  # taken at once
        self._odometry.register_frame(points[usable].astype(np.float64), stamps)
        if not np.isfinite(self._odometry.last_pose).all():
            self._odometry.last_pose, self._odometry.last_delta = before
            return TrackingResult(pose=before[0], lost=True, reason="no finite pose was found")
        return TrackingResult(pose=self._odometry.last_pose)
