"""ORB-SLAM3 as a node: what it reads in each of its modes, and where its vocabulary is."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from events import Announcement, DepthImage, Image, Imu, ImuAnnouncement
from nodes.estimation import Estimator, EstimatorConfig
from nodes.orb_slam3.process import OrbSlam3Process
from nodes.orb_slam3.settings import Mode, OrbSettings, make_settings
from nodes.orb_slam3.vocabulary_file import find_vocabulary
from runtime import Bundle, Duration, on
from runtime.paths import InputPath


class Frame(NamedTuple):
    """A picture, and its depth if the camera gives it."""

    image: Image
    depth: DepthImage | None


class OrbSlam3Config(EstimatorConfig):
    """Settings of ORB-SLAM3.

    Attributes:
        mode: Which sensors it uses.
        vocabulary: File in DBoW2's text format; if empty, the one that
            ``python -m runtime vocabulary CONFIG`` has made.
        orb: What else ORB-SLAM3 can be told.
        patience: Real seconds that its mapping gets for each picture, at most, before the next.
    """

    mode: Mode = "rgbd"
    vocabulary: InputPath = ""
    orb: OrbSettings = OrbSettings()
    patience: Duration = Duration(0.02)  # immutable


class OrbSlam3(Estimator[OrbSlam3Config]):
    """Where a camera has gone, by ORB-SLAM3 in a process of its own.

    Its threads make it vary from run to run, so the digest of a run with it is not promised.
    """

    deterministic: ClassVar[bool] = False

    frames = Bundle(Frame, keep="latest")

    def __init__(self) -> None:
        mode = self.config.mode
        self.needs = frozenset({"grey", "depth"} if "rgbd" in mode else {"grey"})
        self.method = f"ORB-SLAM3 ({mode.replace('_', ', ')})"
        self.scale_free = mode == "monocular"
        self._imu: ImuAnnouncement | None = None
        self._samples: deque[Imu] = deque(maxlen=100_000)

    def on_announcement(self, announcement: Announcement) -> None:
        """Choose the camera, and the first IMU."""
        super().on_announcement(announcement)
        if isinstance(announcement, ImuAnnouncement) and self._imu is None:
            self._imu = announcement
            self.narrow("measured", announcement.source)

    def check(self) -> Iterable[str]:
        """Say if there is no camera, or no vocabulary."""
        yield from super().check()
        try:
            find_vocabulary(self.config.vocabulary)
        except ValueError as error:
            yield str(error)

    @on(Imu)
    def measured(self, event: Imu) -> None:
        """Keep what the IMU says until the next picture."""
        if "inertial" in self.config.mode:
            self._samples.append(event)

    async def on_ready(self) -> None:
        """Start ORB-SLAM3, in a process of its own."""
        config = self.config
        self._slam = await self.worker(
            OrbSlam3Process,
            make_settings(config.mode, self.the_camera(), self._imu, config.orb),
            self._vocabulary(),
            float(config.patience),
            latency=config.latency,
        )

    async def run(self) -> None:
        """Track each image; skip those that come meanwhile."""
        began = False
        async for image, depth in self.frames:
            if ("rgbd" in self.config.mode) != (depth is not None):
                if depth is None:
                    continue
                depth = None
            said = await self._slam.call(
                OrbSlam3Process.track,
                image.stamp,
                image.data,
                None if depth is None else depth.data,
                self._take_samples(image.stamp),
            )
            began = began or not said.lost
            if began:
                self.publish(image, said, origin=said.began if said.began >= 0 else None)

    def _vocabulary(self) -> Path:
        """Return the vocabulary's file.

        Raises:
            FatalError: There is none, or it is in another format.
        """
        try:
            return find_vocabulary(self.config.vocabulary)
        except ValueError as error:
            self.log.fatal("%s", error)

    def _take_samples(self, until: int) -> npt.NDArray[np.float64] | None:
        """Return what was measured since the last picture, shape (n, 7)."""
        if "inertial" not in self.config.mode:
            return None
        rows = []
        while self._samples and self._samples[0].stamp <= until:
            sample = self._samples.popleft()
            rows.append((sample.stamp, *sample.angular_velocity, *sample.linear_acceleration))
        return np.array(rows, np.float64).reshape(-1, 7)
