"""KISS-ICP as a node: the scans it reads, and the estimates it sends."""

from __future__ import annotations

from nodes.estimators import WORKER_ENVIRONMENT, EstimatorConfig, LidarEstimator
from nodes.estimators.kiss_icp.process import INSTALL, KissIcpProcess
from nodes.estimators.kiss_icp.settings import KissIcpSettings


class KissIcpConfig(EstimatorConfig):
    """Settings of KISS-ICP.

    Attributes:
        kiss: KISS-ICP's own settings.
    """

    kiss: KissIcpSettings = KissIcpSettings()


class KissIcp(LidarEstimator[KissIcpConfig]):
    """Estimates the pose of a lidar by KISS-ICP, in a process of its own.

    I. Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
    """

    method = "KISS-ICP"
    library = "kiss_icp", INSTALL

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
        """Track each scan; nothing is sent before one has enough points."""
        tracking = False
        async for scan in self.frames:
            result = await self._kiss.call(KissIcpProcess.track, scan.points, scan.times)
            tracking = tracking or not result.lost
            if tracking:
                self.publish(scan, result)
