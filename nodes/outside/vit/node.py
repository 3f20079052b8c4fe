"""Visual-inertial tracking libraries as estimators; the clock is held for their poses."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from msgspec.structs import replace

from events import CameraAnnouncement, Image, Imu
from nodes.calibration.formats import write_files
from nodes.data.dataset.recording import Rig
from nodes.estimators import (
    Estimator,
    EstimatorConfig,
    MonocularInertialFrame,
    StereoInertialFrame,
    TrackingResult,
)
from nodes.outside.vit.tracker import VitTracker
from runtime import Bundle, Duration
from runtime.channels.hold import Hold, HoldConfig, Owed
from runtime.paths import InputPath


class Frame(NamedTuple):
    """All that either mode reads."""

    image: Image
    left: Image
    right: Image
    imu: tuple[Imu, ...]


class VitConfig(EstimatorConfig):
    """Settings of a library with Monado's VIT interface.

    Attributes:
        library: Path of the shared library.
        config: Path of its own settings; ``$VISNAV_FOLDER`` in it stands for the folder with the
            calibration's files. If empty, the first of these, or the library's defaults.
        mode: The sensors that are used.
        calibration: How it gets the calibration: by the ``interface``; from its own ``config``; or
            from files in the format of ``basalt``, ``openvins`` or ``kalibr`` (see ``export``).
        patience: Real seconds that the first image gets, when the library may give no pose and
            does not say so, and by which time stays behind real time up to the first pose. It must
            be longer than the library takes for its start and an image: a first pose that comes
            later marks the run as not reproducible.
        hold: How long simulated time waits for a pose, and what if none comes.
    """

    library: InputPath
    config: InputPath = ""
    mode: Literal["stereo_inertial", "monocular_inertial"] = "stereo_inertial"
    calibration: Literal["interface", "config", "basalt", "openvins", "kalibr"] = "interface"
    patience: Duration = Duration(0.1)  # immutable
    hold: HoldConfig = HoldConfig(initialise=Duration(10.0))


LEAST = 0.1
"""Real seconds of patience that each image gets, if the setting has as many."""


def patience_left(patience: float, image: float, now: float) -> float:
    """Return the real seconds that an image gets for a first pose.

    Args:
        image: Stamp of the image, seconds after that of the first.
        now: Real seconds since the first image came.
    """
    return max(image + patience - now, min(patience, LEAST))


class Vit(Estimator[VitConfig]):
    """Estimates the pose of a camera or a stereo rig with an IMU by such a library.

    Each image goes to it after all samples of the IMU up to that image, and simulated time waits
    at the latency until the pose has come. The library's threads may make it vary.
    """

    deterministic: ClassVar[bool] = False
    needs = frozenset({"grey"})
    inertial = True
    aligned = False

    frames = Bundle(Frame, keep="latest")

    def __init__(self) -> None:
        stereo = self.config.mode == "stereo_inertial"
        self.read(StereoInertialFrame if stereo else MonocularInertialFrame)
        self.eyes = 2 if stereo else 1
        self.method = Path(self.config.library).stem.removeprefix("lib") or "VIT"
        self._hold: Hold[TrackingResult]
        self._first: tuple[int, float] | None = None  # stamp and real time of the first image
        self._said = False
        self._pose = np.eye(4)

    def refusal(self, camera: CameraAnnouncement) -> str:
        """Return why images would come before samples of the IMU that belong to them."""
        if camera.time_offset >= 0:
            return super().refusal(camera)
        return f"expected a time_offset of at least 0 s, found {camera.time_offset:g} s"

    def check(self) -> Iterable[str]:
        """Return what is missing: sensors, library, settings."""
        yield from super().check()
        for name in ("library", "config"):
            path = getattr(self.config, name)
            if (path or name == "library") and not Path(path).is_file():
                yield f"{name}: expected a file, found none at {path!r}"

    async def on_ready(self) -> None:
        """Start the library, in a process of its own."""
        config = self.config
        body = self.the_camera().source.rpartition("/")[0]
        cameras = (replace(camera, time_offset=0.0) for camera in self.cameras)
        rig = Rig(body, tuple(cameras), self.imu_announcement)
        files: dict[str, str] | None = None if config.calibration == "interface" else {}
        if config.calibration not in {"interface", "config"}:
            try:
                files = write_files(rig, config.calibration, topics=False)
            except ValueError as error:
                self.log.fatal("calibration: %s", error)
        self._hold = self.hold(self.name, config.hold, config.latency)
        told = config.library, config.config, files, rig
        limit = config.hold.max_wait + 60.0
        start = self.worker(VitTracker, *told, latency=config.latency, timeout=limit)
        self._tracker = await start

    async def run(self) -> None:
        """Have the library track each exposure, and hand its poses to whoever waits for them."""
        hold, config = self._hold, self.config
        async for *images, samples in self.frames:
            stamp = self.exposed_at(images[0])
            now = time.monotonic()
            self._first = (stamp, now) if self._first is None else self._first
            since, began = (stamp - self._first[0]) / 1e9, now - self._first[1]
            owed = hold.owe(stamp)
            self.start(self._deliver(images[0], owed))
            early = not self._said and since < config.hold.initialise
            wait = patience_left(config.patience, since, began) if early else config.hold.max_wait
            pixels = [image.data for image in images]
            told = stamp, pixels, samples, float(wait) if hold.expects else 0.0
            for of, result in await self._tracker.call(VitTracker.track, *told):
                self._said = True
                hold.answer(of, result, "lost" if result.lost else "")
            if early and not owed.work.done():
                hold.answer(stamp, None, "initialising")

    async def _deliver(self, image: Image, owed: Owed[TrackingResult]) -> None:
        """Publish the pose of an image; of one without, that it is lost."""
        result = await owed
        if result is not None:
            self._pose = result.pose
            self.publish(image, result)
        elif self._said:
            self.publish(image, TrackingResult(self._pose, True, "the library gave no pose"))
