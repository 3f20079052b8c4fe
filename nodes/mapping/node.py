"""Mapping as a node: choice of the camera, source of its pose, and output."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Odometry,
    PointCloud,
    PoseStamped,
)
from events.geometry import pose_matrix
from nodes.estimators import WORKER_ENVIRONMENT
from nodes.mapping.cloud import Mapper
from nodes.trajectory.table import part_name
from runtime import Bundle, Duration, Node, NodeConfig, Output, on
from runtime.paths import OutputPath
from runtime.units import Latency


class ColourDepthPose(NamedTuple):
    """Image, depth image and camera pose of the same exposure."""

    image: Image
    depth: DepthImage
    pose: PoseStamped


class MappingConfig(NodeConfig):
    """Settings of a cloud.

    Attributes:
        pose: ``matched``: the camera's pose of the depth image's own stamp. ``latest``: the
            vehicle's newest odometry, and the camera's mounting on it: later than the image, so the
            cloud smears.
        voxel: Edge of a voxel, metres: no two points of the cloud share one.
        stride: Take every n-th pixel of every n-th row.
        max_depth: Metres, beyond which points are left out.
        every: Least time between two frames.
        latency: Run-clock seconds of a frame's mapping; others meanwhile are skipped.
        rate: Clouds to send a second, at most; 0: only the one at the end.
        file: In the run's folder; empty for ``clouds/<name>.ply``.
    """

    pose: Literal["matched", "latest"] = "matched"
    voxel: Annotated[float, msgspec.Meta(ge=0.001)] = 0.05
    stride: Annotated[int, msgspec.Meta(ge=1)] = 2
    max_depth: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    every: Duration = Duration(0.1)  # immutable
    latency: Latency = Latency(0.03)
    rate: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    file: OutputPath = ""


class Mapping(Node[MappingConfig]):
    """A coloured cloud of the world, from depth images and the true poses."""

    reads_truth = "mapping"
    frames = Bundle(ColourDepthPose, keep="latest")
    clouds = Output(PointCloud)

    def __init__(self) -> None:
        self._camera: CameraAnnouncement | None = None
        self._vehicle: Odometry | None = None  # the newest
        self._frame_id = "map"
        self._stamp = 0
        self._used = 0

    async def on_startup(self) -> None:
        """Start the worker process of the cloud; a thread would hold Python's lock too often."""
        config = self.config
        self._mapper = await self.worker(
            Mapper,
            config.stride,
            config.voxel,
            config.max_depth,
            latency=config.latency,
            env=WORKER_ENVIRONMENT,
        )

    def on_announcement(self, announcement: Announcement) -> None:
        """Take the first camera with depth and colours, or the camera named in the file."""
        if not isinstance(announcement, CameraAnnouncement) or self._camera is not None:
            return
        named, gives = self.sources.get("frames"), {*announcement.images}
        if named not in (None, announcement.source):
            return
        if not ("depth" in gives and gives & {"rgb", "grey"}):
            if named is None:
                return
            raise ValueError(
                f"expected a camera with depth and rgb (or grey) images, found one with "
                f"{', '.join(announcement.images)}"
            )
        self._camera = announcement
        self.narrow("frames", announcement.source)

    def check(self) -> Iterable[str]:
        """Yield an error if no camera gives depth and colours."""
        if self._camera is None:
            yield self._lacking()

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Keep the newest odometry of the camera's vehicle."""
        camera, before = self._camera, self._vehicle
        if camera is not None and camera.source.startswith(f"{event.source}/"):
            self._frame_id = event.frame_id
            if event.child_frame_id == camera.parent_frame_id and (
                before is None or event.stamp >= before.stamp
            ):
                self._vehicle = event

    async def run(self) -> None:
        """Add frames to the cloud."""
        config, camera, mapper = self.config, self._the_camera(), self._mapper
        every, between = round(config.every * 1e9), 1e9 / config.rate if config.rate else math.inf
        due, cloud_due = 0, 0.0 if config.rate else math.inf
        pixels = slice(None, None, config.stride)
        async for image, depth, pose in self.frames:
            placed = self._placed(camera, pose)
            if image.stamp < due or placed is None:
                continue
            due = image.stamp + every
            await mapper.call(
                Mapper.add,
                camera.info,
                np.ascontiguousarray(depth.data[pixels, pixels]),
                np.ascontiguousarray(image.data[pixels, pixels]),
                placed,
            )
            self._stamp = image.stamp
            self._used += 1
            if image.stamp >= cloud_due:
                cloud_due = image.stamp + between
                await self._send()

    def _lacking(self) -> str:
        named = self.sources.get("frames")
        return (
            "expected a camera with depth and rgb (or grey) images"
            f"{f' called {named}' if named else ''}, found none announced"
        )

    def _the_camera(self) -> CameraAnnouncement:
        if self._camera is None:
            self.log.fatal("%s", self._lacking())
        return self._camera

    def _placed(
        self, camera: CameraAnnouncement, pose: PoseStamped
    ) -> npt.NDArray[np.float64] | None:
        """Return where the settings take the camera to be, shape (4, 4); `None` if not known."""
        if self.config.pose == "matched":
            self._frame_id = pose.frame_id
            return pose_matrix(pose.position, pose.orientation)
        if (vehicle := self._vehicle) is None:  # it has not said where it is
            return None
        mounting = pose_matrix(camera.position, camera.orientation)
        return pose_matrix(vehicle.position, vehicle.orientation) @ mounting

    async def _send(self) -> int:
        points, colours = await self._mapper.call_for(0.0, Mapper.cloud)
        self.clouds.send(
            PointCloud(
                stamp=self._stamp,
                source=self.name,
                frame_id=self._frame_id,
                points=points,
                colors=colours,
            )
        )
        return len(points)

    async def on_shutdown(self) -> None:
        """Write and send the final cloud."""
        if not self._used:
            self.log.warning("no frame came: there is no cloud")
            return
        if self.out is not None:
            path = self.out / part_name(self, self.config.file or f"clouds/{self.name}.ply")
            await self._mapper.call_for(0.0, Mapper.write, path, self._frame_id)
        self.log.info("%d points from %d frames", await self._send(), self._used)
