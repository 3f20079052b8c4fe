"""Recording as AirSim does it: images, and a table that says where each vehicle was then.

Unlike AirSim's, a row's pose is that of its images' instant (in real time, within 1 ms). Source of
the format: ``RecordingFile`` and ``FileSystem`` of AirSim 1.8.1.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Awaitable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np

from runtime.time.schedule import SECOND
from runtime.units import Duration
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.structures import ImageRequest, ImageResponse, Pose, Vector3r
from sims.cameras import GraphicsError

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

HEADER = "VehicleName TimeStamp POS_X POS_Y POS_Z Q_W Q_X Q_Y Q_Z ImageFile".replace(" ", "\t")

LEAST_INTERVAL = 1e-3
"""Seconds: the step of physics."""

STILL = 1e-3
"""What position, in metres, and quaternion of a vehicle that stands may have changed by."""


class RecordedImage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An image that is taken at each instant of a recording.

    Attributes:
        camera: Name of the camera.
        image_type: AirSim's number of the type.
        pixels_as_float: Whether it is a PFM of one number a pixel.
        compress: Whether it is a PNG, else a PPM.
        vehicle: The vehicle that carries the camera; empty for every vehicle.
    """

    camera: str = "0"
    image_type: int = 0
    pixels_as_float: bool = False
    compress: bool = True
    vehicle: str = ""


class RecordingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of recordings.

    Attributes:
        enabled: Whether one begins with the run, without being asked for.
        on_move: Whether a vehicle is left out while it stands.
        interval: Simulated time between two instants.
        folder: Folder in the run's folder; each recording is a folder in it, named by the date.
        images: What is taken of each vehicle.
    """

    enabled: bool = False
    on_move: bool = False
    interval: Duration = Duration(0.05)  # immutable
    folder: Annotated[str, msgspec.Meta(pattern=r"^[\w-]+\Z")] = "recording"
    images: tuple[RecordedImage, ...] = (RecordedImage(),)

    def __post_init__(self) -> None:
        if self.interval < LEAST_INTERVAL:
            raise ValueError(f"interval: expected at least 1 ms, found {self.interval:g} s")


class Recording:
    """Starts and stops recordings."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._config = server.config.recording
        self._folder: Path | None = None
        self._failed = ""
        self._last: dict[str, Pose] = {}

    async def begin(self) -> None:
        """Start recording with the run, if the settings say so."""
        try:
            if self._config.enabled and (started := self.start()):
                await started
        except RpcError as error:
            self._server.log.error("%s", error)

    @rpc("startRecording")
    def start(self) -> Awaitable[None] | None:
        """Record the settings' images and true poses into a folder in the run's folder."""
        out = self._server.out
        if out is None:
            raise RpcError("expected a run with a folder of results, found one without")
        if self._folder is not None:
            return None
        self._folder, self._failed = out / self._config.folder, ""
        return self._started(self._folder)

    async def _started(self, base: Path) -> None:
        server = self._server
        try:
            await server.images.start()
            folder = await server.offload(_make_folder, base)
        except (OSError, GraphicsError) as error:
            self._folder = None
            raise RpcError(f"the recording could not begin: {error}") from None
        if self._folder is base:  # it has not been stopped meanwhile
            self._folder, self._last = folder, {}
            server.log.info("recording into %s", folder)
            server.start(self._record(folder))

    @rpc("stopRecording")
    def stop(self) -> None:
        """End the recording, or say why it has ended before."""
        self._folder, failed, self._failed = None, self._failed, ""
        if failed:
            raise RpcError(failed)

    @rpc("isRecording")
    def is_recording(self) -> bool:
        """Return whether images are recorded."""
        return self._folder is not None

    async def _record(self, folder: Path) -> None:
        clock, interval = self._server.clock, round(self._config.interval * SECOND)
        stamp = clock.now()
        while self._folder == folder:
            try:
                for name in sorted(self._server.vehicles):
                    await self._record_vehicle(name, folder)
            except (OSError, RpcError) as error:
                self._failed = f"the recording has ended: {error}"
                self._server.log.error("%s", self._failed)
                self._folder = None
                return
            stamp = max(stamp + interval, clock.now())
            await clock.sleep_until(stamp)

    async def _record_vehicle(self, name: str, folder: Path) -> None:
        """Record a vehicle at this instant; simulated time waits for it."""
        server = self._server
        pose = server.find_vehicle(name).pose()
        before = _numbers(self._last.get(name, Pose(Vector3r(math.inf))))
        if self._config.on_move and np.allclose(_numbers(pose), before, rtol=0.0, atol=STILL):
            return
        self._last[name] = pose
        requests = [
            ImageRequest(each.camera, each.image_type, each.pixels_as_float, each.compress)
            for each in self._config.images
            if each.vehicle in {"", name}
        ]

        async def take(taken: Awaitable[list[ImageResponse]]) -> list[ImageResponse]:
            return await taken

        if requests:
            taken = take(server.images.take(requests, name, "cosys"))  # whose colours are RGB
            loop = asyncio.get_running_loop()
            images = await server.clock.beside(asyncio.run_coroutine_threadsafe(taken, loop))
            await server.offload(_write, folder, name, pose, images)


def _make_folder(base: Path) -> Path:
    """Make a folder named by the date, with an empty table, and return it."""
    date = time.strftime("%Y-%m-%d-%H-%M-%S")
    names = (date, *(f"{date}-{number}" for number in range(2, 1000)))
    folder = next(base / name for name in names if not (base / name).exists())
    (folder / "images").mkdir(parents=True)
    (folder / "airsim_rec.txt").write_text(f"{HEADER}\n", encoding="utf-8")
    return folder


def _write(folder: Path, vehicle: str, pose: Pose, images: list[ImageResponse]) -> None:
    """Write images of one instant, and a row that names them."""
    names = []
    for image in images:
        suffix = "pfm" if image.pixels_as_float else "png" if image.compress else "ppm"
        camera = re.sub(r"[^\w-]", "_", image.camera_name)
        name = f"img_{vehicle}_{camera}_{image.image_type}_{image.time_stamp}.{suffix}"
        (folder / "images" / name).write_bytes(_file(image, suffix))
        names.append(name)
    stamp = images[0].time_stamp // 1_000_000
    row = [vehicle, stamp, *(f"{number:.9g}" for number in _numbers(pose)), ";".join(names)]
    with (folder / "airsim_rec.txt").open("a", encoding="utf-8") as table:
        table.write("\t".join(map(str, row)) + "\n")


def _numbers(pose: Pose) -> tuple[float, ...]:
    return *msgspec.structs.astuple(pose.position), *msgspec.structs.astuple(pose.orientation)


def _file(image: ImageResponse, suffix: str) -> bytes:
    """Return an image as a file; a PFM has its rows from top to bottom, as AirSim writes it."""
    size = f"{image.width} {image.height}\n"
    if suffix == "pfm":
        numbers = np.array(msgspec.msgpack.decode(image.image_data_float), "<f4")
        return f"Pf\n{size}-1\n".encode() + numbers.tobytes()
    header = f"P6\n{size}255\n".encode() if suffix == "ppm" else b""
    return header + image.image_data_uint8
