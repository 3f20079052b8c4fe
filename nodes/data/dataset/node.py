"""Records a run's sensors and ground truth as a data set, beside the loop."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from events import Announcement, DepthImage, Image, Imu, Odometry, PoseStamped
from nodes.data.dataset.layouts import Euroc, TumMono, TumRgbd
from nodes.data.dataset.recording import ImageFile, Recording, choose
from nodes.trajectory_files import EPOCH, epoch_of, part_name
from runtime import Input, Node, NodeConfig, Stream, on
from runtime.errors import ConfigError
from runtime.paths import OutputPath

_LAYOUTS: dict[str, type[Recording]] = {"euroc": Euroc, "tum_rgbd": TumRgbd, "tum_mono": TumMono}
_AT_ONCE = 4  # image files written concurrently
_WAITING = 64  # images of a kind waiting for the disk: then lockstep waits, real time drops some


class DatasetConfig(NodeConfig):
    """Settings of a recorded data set.

    Attributes:
        format: ``euroc``: grey images of all cameras of the first camera's vehicle (and depth),
            IMU, the vehicle's poses. ``tum_rgbd``: colour and depth images of the first camera and
            its poses. ``tum_mono``: grey images of the first camera, its photometric calibration
            and poses, as DSO reads them.
        folder: Its name in the run's folder; replaces an older data set.
        depth_factor: Steps of a depth image per metre; 65535 are the limit (5000: 13.1 m), deeper
            is written as none.
        epoch: The run's time 0 in the files: a date (ISO 8601), or nanoseconds of Unix time; noted
            as ``epoch_ns`` for replays.
    """

    format: Literal["euroc", "tum_rgbd", "tum_mono"] = "euroc"
    folder: Annotated[OutputPath, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]+$")] = "dataset"
    depth_factor: Annotated[float, msgspec.Meta(gt=0)] = 5000.0
    epoch: int | str = EPOCH

    def __post_init__(self) -> None:
        epoch_of(self.epoch)


class DatasetWriter(Node[DatasetConfig]):
    """Writes images, IMU measurements and the ground truth in the layout of EuRoC or of TUM.

    Choose a camera (or vehicle) by ``inputs = { images = "drone/front" }``. The files' world is
    north, west, up. A restart begins a numbered folder (``dataset-2``).
    """

    reads_truth = "recording"
    images = Input(Image, bound=_WAITING, overflow="drop_oldest")
    depth_images = Input(DepthImage, bound=_WAITING, overflow="drop_oldest")

    async def on_startup(self) -> None:
        """Create the output folder."""
        self._announcements: list[Announcement] = []
        self._recording: Recording | None = None
        self._unwritten: set[ImageFile] = set()
        self._queue: asyncio.Queue[ImageFile] = asyncio.Queue(maxsize=1)
        if self.out is not None:
            self._folder = self.out / part_name(self, self.config.folder)
            await self.offload(_make_empty, self._folder)

    def on_announcement(self, announcement: Announcement) -> None:
        """Store an announcement, to choose the sensors later."""
        self._announcements.append(announcement)

    async def run(self) -> None:
        """Write images in the background as they arrive."""
        self._open()
        for _ in range(_AT_ONCE):
            self.start(self._write())
        self.start(self._enqueue_images(self.depth_images))
        await self._enqueue_images(self.images)

    async def _enqueue_images(self, images: Stream[Any]) -> None:
        async for image in images:
            if (file := self._add(image)) is not None:
                await self._queue.put(file)

    async def _write(self) -> None:
        while True:
            file = await self._queue.get()
            await self.offload(file)
            self._unwritten.discard(file)

    @on(PoseStamped)
    def camera_poses(self, event: PoseStamped) -> None:
        """Record a camera's pose."""
        if (recording := self._open()) is not None:
            recording.pose(event)

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Record the vehicle's pose."""
        if (recording := self._open()) is not None:
            recording.odometry(event)

    @on(Imu)
    def imu(self, event: Imu) -> None:
        """Record an IMU sample."""
        if (recording := self._open()) is not None:
            recording.imu(event)

    async def on_shutdown(self) -> None:
        """Write the remaining images, and report missing data."""
        if self._recording is None:
            return
        for images in (self.images, self.depth_images):
            for _ in range(images.statistics().buffered):
                self._add(images.receive_nowait())
        await self.offload(_finish, self._recording, list(self._unwritten))
        for warning in self._recording.warnings():
            self.log.warning("%s", warning)
        dropped = self.images.statistics().dropped + self.depth_images.statistics().dropped
        if dropped:
            self.log.warning("%d images are missing: writing was too slow for them", dropped)
        if left_out := self._recording.left_out():
            self.log.warning("%d events came out of order and are left out", left_out)
        if empty := self._recording.empty():
            self.log.warning("nothing came for %s", ", ".join(empty))

    def _open(self) -> Recording | None:
        """Return the recording, created at the first event, when all announcements are known."""
        if self._recording is None and self.out is not None:
            layout = _LAYOUTS[self.config.format]
            try:
                rig = choose(self._announcements, self.sources.get("images"))
                epoch = epoch_of(self.config.epoch)
                self._recording = layout(self._folder, rig, self.config.depth_factor, epoch)
            except ValueError as error:
                self.log.fatal("%s", error)
        return self._recording

    def _add(self, event: Image | DepthImage) -> ImageFile | None:
        """Add an image; its file is stored until written, in case the run ends before."""
        if (recording := self._open()) is None:
            return None
        file = recording.image(event) if isinstance(event, Image) else recording.depth(event)
        if file is not None:
            self._unwritten.add(file)
        return file


def _make_empty(folder: Path) -> None:
    """Create a folder without files of an earlier run; raise a `ConfigError` if it has others."""
    if folder.is_dir() and any(folder.iterdir()):
        if not any((folder / sign).exists() for sign in ("mav0", "rgb.txt", "times.txt")):
            raise ConfigError(
                f"folder: expected the name of a new folder, or of an earlier data set, "
                f"found {folder} with other files"
            )
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)


def _finish(recording: Recording, files: list[ImageFile]) -> None:
    try:
        for file in files:
            file()
    finally:
        recording.close()
