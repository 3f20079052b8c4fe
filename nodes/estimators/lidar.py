"""The base of estimators that read a lidar's scans."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
from typing_extensions import TypeVar

from events import Announcement, EstimatorAnnouncement, LidarAnnouncement, LidarScan
from nodes.estimators.estimator import Estimator, EstimatorConfig, Frame
from nodes.estimators.result import TrackingResult
from runtime import Input

C = TypeVar("C", bound=EstimatorConfig, default=EstimatorConfig)


class LidarEstimator(Estimator[C]):
    """Base of the nodes that estimate poses from a lidar's scans.

    Its tracker gives poses of the lidar (x forward, y right, z down) in the lidar at its first
    scan; all else is as `Estimator` has it of a camera. The pose of a scan is that at its last ray.
    """

    needs = frozenset({"lidar"})
    lenses = frozenset()

    frames = Input(LidarScan, keep="latest")

    lidar: LidarAnnouncement | None = None
    """The lidar whose scans are read: the first, or the one that the file names as ``frames``."""

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates, of which no lens is rectified."""
        for announcement in super().announce():
            assert isinstance(announcement, EstimatorAnnouncement)
            yield msgspec.structs.replace(announcement, rectifies=False)

    def on_announcement(self, announcement: Announcement) -> None:
        """Take the lidar."""
        super().on_announcement(announcement)
        named = self.sources.get("frames", announcement.source)
        if isinstance(announcement, LidarAnnouncement) and announcement.source == named:
            self.lidar = announcement
            self.narrow("frames", announcement.source)

    def the_lidar(self) -> LidarAnnouncement:
        """Return the announcement of the lidar whose scans are read.

        Raises:
            FatalError: There is none.
        """
        if self.lidar is None:
            self.log.fatal("%s", self._missing())
        return self.lidar

    def exposed_at(self, image: Frame) -> int:
        """Return when a scan's last ray was sent (ns)."""
        return image.end if isinstance(image, LidarScan) else super().exposed_at(image)

    def _sensor(self) -> LidarAnnouncement:
        return self.the_lidar()

    def _missing(self) -> str:
        called = f" called {self.sources['frames']}" if "frames" in self.sources else ""
        return "" if self.lidar else f"expected a lidar{called}, found none"

    def _send_features(self, image: Frame, result: TrackingResult) -> None:
        """Send none: a scan has none."""
