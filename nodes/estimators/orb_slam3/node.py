"""ORB-SLAM3 as a node: its inputs in each of its modes, and its vocabulary."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple

from events import DepthImage, Image, Imu
from nodes.estimators import (
    Estimator,
    EstimatorConfig,
    MonocularFrame,
    MonocularInertialFrame,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
    sample_rows,
)
from nodes.estimators.orb_slam3.process import INSTALL, OrbSlam3Process
from nodes.estimators.orb_slam3.settings import LENSES, Mode, OrbSettings, make_settings
from nodes.estimators.orb_slam3.vocabulary import find_vocabulary
from runtime import Bundle, Duration
from runtime.paths import InputPath


class Frame(NamedTuple):
    """Fields read in any mode."""

    image: Image
    depth: DepthImage | None
    left: Image | None
    right: Image | None
    imu: Imu | None


_FRAMES: dict[Mode, type[tuple[Any, ...]]] = {
    "rgbd": RgbdFrame,
    "monocular": MonocularFrame,
    "stereo": StereoFrame,
    "rgbd_inertial": RgbdInertialFrame,
    "monocular_inertial": MonocularInertialFrame,
    "stereo_inertial": StereoInertialFrame,
}


class OrbSlam3Config(EstimatorConfig):
    """Settings of ORB-SLAM3.

    Attributes:
        mode: The sensors used.
        vocabulary: File in DBoW2's text format; if empty, that of ``python -m runtime vocabulary
            CONFIG``.
        orb: ORB-SLAM3's own settings.
        mapping_timeout: Processor time of its other threads after each image, at most.
    """

    mode: Mode = "rgbd"
    vocabulary: InputPath = ""
    orb: OrbSettings = OrbSettings()
    mapping_timeout: Duration = Duration(0.02)  # immutable


class OrbSlam3(Estimator[OrbSlam3Config]):
    """Estimator of a camera's pose by ORB-SLAM3, in a process of its own.

    Because of its threads the results vary from run to run, and so does the digest.
    """

    deterministic: ClassVar[bool] = False
    library = "pyorbslam3", INSTALL

    frames = Bundle(Frame, keep="latest")

    def __init__(self) -> None:
        mode = self.config.mode
        self.needs = frozenset({"grey", "depth"} if "rgbd" in mode else {"grey"})
        self.eyes = 2 if "stereo" in mode else 1
        self.inertial = "inertial" in mode
        self.lenses = LENSES[mode.removesuffix("_inertial")]
        self.method = f"ORB-SLAM3 ({mode.replace('_', ', ')})"
        self.scale_free = mode == "monocular"
        self.read(_FRAMES[mode])

    def check(self) -> Iterable[str]:
        """Return the errors: no camera, an IMU on another body, or no vocabulary."""
        missing = [*super().check()]
        yield from missing
        if missing:
            return
        config = self.config
        try:
            self._settings = make_settings(
                config.mode, self.cameras, self.imu_announcement, config.orb
            )
            self._vocabulary = find_vocabulary(config.vocabulary)
        except ValueError as error:
            yield str(error)

    async def on_ready(self) -> None:
        """Start ORB-SLAM3, in a process of its own."""
        told = self._settings, self._vocabulary, float(self.config.mapping_timeout)
        self._slam = await self.worker(OrbSlam3Process, *told, latency=self.config.latency)

    async def run(self) -> None:
        """Track each image; images arriving meanwhile are skipped."""
        initialized = False
        async for frame in self.frames:
            given = frame._asdict()
            image = frame[0]
            result = await self._slam.call(
                OrbSlam3Process.track,
                self.exposed_at(image),
                image.data,
                given["depth"].data if "depth" in given else None,
                given["right"].data if "right" in given else None,
                sample_rows(given["imu"]) if "imu" in given else None,
            )
            initialized = initialized or not result.lost
            if initialized:
                first = result.first_keyframe
                self.publish(image, result, origin=first if first >= 0 else None)

    async def on_end(self) -> None:
        """Send the trajectory after loop closures and other corrections."""
        self.publish_trajectory(*await self._slam.call_for(0.0, OrbSlam3Process.trajectory))
