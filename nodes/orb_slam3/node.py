"""ORB-SLAM3 as a node: its inputs in each of its modes, and its vocabulary."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
)
from nodes.estimation import Estimator, EstimatorConfig
from nodes.orb_slam3.process import OrbSlam3Process
from nodes.orb_slam3.settings import Mode, OrbSettings, make_settings, unknown_lens
from nodes.orb_slam3.vocabulary_file import find_vocabulary
from runtime import Bundle, Duration, on
from runtime.paths import InputPath


class Frame(NamedTuple):
    """An image, and its depth if the camera gives it."""

    image: Image
    depth: DepthImage | None


class OrbSlam3Config(EstimatorConfig):
    """Settings of ORB-SLAM3.

    Attributes:
        mode: The sensors that are used.
        vocabulary: File in DBoW2's text format; if empty, the one that
            ``python -m runtime vocabulary CONFIG`` has made.
        orb: ORB-SLAM3's own settings.
        mapping_timeout: Real time that its mapping gets for each image, at most, before the next.
    """

    mode: Mode = "rgbd"
    vocabulary: InputPath = ""
    orb: OrbSettings = OrbSettings()
    mapping_timeout: Duration = Duration(0.02)  # immutable


class OrbSlam3(Estimator[OrbSlam3Config]):
    """Estimates the pose of a camera by ORB-SLAM3, in a process of its own.

    Because of its threads the results vary from run to run, and so does the digest.
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
            self.narrow("imu", announcement.source)

    def refusal(self, camera: CameraAnnouncement) -> str:
        """Return why ORB-SLAM3 has no model of a camera."""
        return unknown_lens(self.config.mode, camera.info)

    def check(self) -> Iterable[str]:
        """Return the errors: no camera, or no vocabulary."""
        yield from super().check()
        try:
            find_vocabulary(self.config.vocabulary)
        except ValueError as error:
            yield str(error)

    @on(Imu)
    def imu(self, event: Imu) -> None:
        """Keep the samples of the IMU until the next image."""
        if "inertial" in self.config.mode:
            self._samples.append(event)

    async def on_ready(self) -> None:
        """Start ORB-SLAM3, in a process of its own."""
        config = self.config
        self._slam = await self.worker(
            OrbSlam3Process,
            make_settings(config.mode, self.the_camera(), self._imu, config.orb),
            self._vocabulary(),
            float(config.mapping_timeout),
            latency=config.latency,
        )

    async def run(self) -> None:
        """Track each image; those that arrive meanwhile are skipped."""
        initialized = False
        async for image, depth in self.frames:
            if ("rgbd" in self.config.mode) != (depth is not None):
                if depth is None:
                    continue
                depth = None
            stamp = self.exposed_at(image)
            result = await self._slam.call(
                OrbSlam3Process.track,
                stamp,
                image.data,
                None if depth is None else depth.data,
                self._take_samples(stamp),
            )
            initialized = initialized or not result.lost
            if initialized:
                first = result.first_keyframe
                self.publish(image, result, origin=first if first >= 0 else None)

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
        """Return the samples since the last image, shape (n, 7)."""
        if "inertial" not in self.config.mode:
            return None
        rows = []
        while self._samples and self._samples[0].stamp <= until:
            sample = self._samples.popleft()
            rows.append((sample.stamp, *sample.angular_velocity, *sample.linear_acceleration))
        return np.array(rows, np.float64).reshape(-1, 7)
