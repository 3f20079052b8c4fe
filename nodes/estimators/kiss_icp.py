"""KISS-ICP in a worker's process, and its node: scans in, estimates out.

The library is imported when an object is made, so that others may import this module for its names.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from events import LidarAnnouncement, LidarScan
from nodes.estimators import WORKER_ENVIRONMENT, Estimator, EstimatorConfig, TrackingResult
from runtime import Input
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class KissIcpSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """KISS-ICP's own settings.

    Attributes:
        voxel_size: Side of the map's voxels, metres; 0 for a hundredth of the range.
        max_points_per_voxel: Points that a voxel of the map holds, at most.
        max_range: Points farther away are left out, metres; 0 for the lidar's own range.
        deskew: Whether scans are corrected for the motion during a turn, which is taken to be that
            of the turn before.
        initial_threshold: Distance up to which points are first matched, metres.
        min_motion: Deviation from constant motion below which the threshold is not adapted, metres.
        min_points: Points of a scan below which the lidar is lost.
    """

    voxel_size: NotNegative = 0.0
    max_points_per_voxel: Annotated[int, msgspec.Meta(ge=1)] = 20
    max_range: NotNegative = 0.0
    deskew: bool = True
    initial_threshold: Positive = 2.0
    min_motion: Positive = 0.1
    min_points: Annotated[int, msgspec.Meta(ge=10)] = 100


INSTALL = install_command("kiss-icp")


class KissIcpProcess:
    """Registers each scan with a map of voxels.

    It computes in the frame of the points, whichever that is, with one thread: the sums of several
    would have no fixed order.

    Args:
        lidar: Whose ranges are the limits.

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


class KissIcpConfig(EstimatorConfig):
    """Settings of KISS-ICP.

    Attributes:
        kiss: KISS-ICP's own settings.
    """

    kiss: KissIcpSettings = KissIcpSettings()


class KissIcp(Estimator[KissIcpConfig]):
    """Estimates the pose of a lidar by KISS-ICP, in a process of its own.

    I. Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
    """

    needs = frozenset({"lidar"})
    lenses = frozenset()
    method = "KISS-ICP"
    library = "kiss_icp", INSTALL

    frames = Input(LidarScan, keep="latest")

    async def on_ready(self) -> None:
        """Start KISS-ICP, in a process of its own."""
        self._kiss = await self.worker(
            KissIcpProcess,
            self.the_lidar(),
            self.config.kiss,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each scan; estimates start with the first scan of enough points."""
        tracking = False
        async for scan in self.frames:
            result = await self._kiss.call(KissIcpProcess.track, scan.points, scan.times)
            tracking = tracking or not result.lost
            if tracking:
                self.publish(scan, result)
