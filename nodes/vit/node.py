"""Visual-inertial tracking libraries as estimators; the clock is held for their poses."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from events import Image, Imu
from nodes.calibration.formats import write_files
from nodes.dataset.rig import Rig
from nodes.estimation import Estimator, EstimatorConfig, StereoInertialFrame, TrackingResult
from nodes.vit.tracker import VitSettings, VitTracker
from runtime import Bundle, Duration
from runtime.hold import Hold, HoldConfig
from runtime.owed import Owed
from runtime.paths import InputPath


class InertialFrame(NamedTuple):
    """An image, and the samples of the IMU since the one before."""

    image: Image
    imu: tuple[Imu, ...]


class VitConfig(EstimatorConfig):
    """Settings of a library with Monado's VIT interface.

    Attributes:
        library: Path of the shared library.
        config: Path of its own settings; ``$VISNAV_FOLDER`` in it stands for the folder with the
            calibration's files. If empty, the first of these, or the library's defaults.
        calibration: How it gets the calibration: by the ``interface``; from its own ``config``; or
            from files in the format of ``basalt``, ``openvins`` or ``kalibr`` (see ``export``).
        patience: Real seconds that an image gets before the first pose, when the library may give
            none and does not say so. It must be longer than the library takes for an image: a
            pose that comes later marks the run as not reproducible.
        hold: How long simulated time waits for a pose, and what if none comes.
    """

    library: InputPath
    config: InputPath = ""
    calibration: Literal["interface", "config", "basalt", "openvins", "kalibr"] = "interface"
    patience: Duration = Duration(0.1)  # immutable
    hold: HoldConfig = HoldConfig(initialise=Duration(10.0))


class Vit(Estimator[VitConfig]):
    """Estimates the pose of a stereo rig with an IMU by a library with Monado's VIT interface.

    Each image goes to the library after all samples of the IMU up to it, and simulated time waits
    at its latency until its pose has come. The library's threads may make it vary from run to run.
    """

    deterministic: ClassVar[bool] = False
    needs = frozenset({"grey"})
    eyes = 2
    inertial = True
    aligned = False

    frames = Bundle(StereoInertialFrame, keep="latest")

    def __init__(self) -> None:
        self.method = Path(self.config.library).stem.removeprefix("lib") or "VIT"
        self._hold: Hold[TrackingResult]
        self._first: int | None = None
        self._said = False
        self._pose = np.eye(4)

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
        rig = Rig(self.the_camera().source.rpartition("/")[0], self.cameras, self.imu_announcement)
        settings = VitSettings(
            library=config.library,
            config=config.config,
            files=self._files(rig),
            rig=rig,
            by_interface=config.calibration == "interface",
        )
        limit = config.hold.max_wait + 60.0
        self._hold = self.hold(self.name, config.hold, config.latency)
        start = self.worker(VitTracker, settings, latency=config.latency, timeout=limit)
        self._tracker = await start

    def _files(self, rig: Rig) -> dict[str, str]:
        """Return the files of the calibration, if it is passed by files."""
        if self.config.calibration in {"interface", "config"}:
            return {}
        try:
            return write_files(rig, self.config.calibration)
        except ValueError as error:
            self.log.fatal("calibration: %s", error)

    async def run(self) -> None:
        """Track each exposure; those that come meanwhile are skipped."""
        async for left, right, samples in self.frames:
            await self._track((left, right), samples)

    async def _track(self, images: tuple[Image, ...], samples: tuple[Imu, ...]) -> None:
        """Have the library track an exposure, and hand its poses to whoever waits for them."""
        stamp, hold = images[0].stamp, self._hold
        self._first = stamp if self._first is None else self._first
        owed = hold.owe(stamp)
        self.start(self._deliver(images[0], owed))
        early = not self._said and stamp - self._first < self.config.hold.initialise * 1e9
        wait = float(self.config.patience if early else self.config.hold.max_wait)
        rows = [(s.stamp, *s.angular_velocity, *s.linear_acceleration) for s in samples]
        found = await self._tracker.call(
            VitTracker.track,
            stamp,
            [image.data for image in images],
            np.array(rows, np.float64).reshape(-1, 7),
            wait if hold.expects else 0.0,
        )
        for of, result in found:
            if not self._said and stamp - of > self.config.hold.tolerance_ns:
                hold.answers.why_not["its first pose came after its patience"] = None
            self._said = True
            hold.answer(of, result)
        if early and not owed.work.done():
            hold.answer(stamp, None)

    async def _deliver(self, image: Image, owed: Owed[TrackingResult]) -> None:
        """Publish the pose of an image; of one without, that it is lost."""
        result = await owed
        if result is not None:
            self._pose = result.pose
            self.publish(image, result)
        elif self._said:
            self.publish(image, TrackingResult(self._pose, True, "the library gave no pose"))


class MonocularVit(Vit):
    """Estimates the pose of a single camera with an IMU by such a library; see `Vit`."""

    eyes = 1

    frames = Bundle(InertialFrame, keep="latest")  # type: ignore[assignment]

    async def run(self) -> None:
        """Track each image; those that come meanwhile are skipped."""
        async for image, samples in self.frames:
            await self._track((image,), samples)
