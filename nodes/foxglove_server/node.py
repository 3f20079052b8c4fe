"""The server as a node: what it hears, and where that is passed on."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

from events import (
    Announcement,
    DepthImage,
    Event,
    Image,
    Imu,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    PositionSetpoint,
    Score,
    TrackedFeatures,
    TrackingEvent,
    VehicleEvent,
)
from nodes.foxglove_server.publishing import Publishing
from nodes.foxglove_server.server import Server
from nodes.foxglove_server.settings import FoxgloveConfig
from nodes.viewing.images import Thinning
from runtime import Node, Stream, Tick, every, on
from runtime.errors import MissingDependencyError, VisnavError

WAITING = 8
"""Pictures of one kind that wait to be passed on; the oldest is dropped, and counted."""


_REFUSALS = 10
"""Different ones that are logged."""


class FoxgloveServer(Node[FoxgloveConfig]):
    """Shows a run, live, in Foxglove: *Open connection*, ``ws://localhost:8765``.

    ::

        [[nodes]]
        name = "foxglove"
        type = "nodes.foxglove_server:FoxgloveServer"

    What is announced has its topics from the start; what is not, from its first event. Who begins
    to look late gets calibrations, fixed transforms, clouds and the paths flown so far.
    """

    def __init__(self) -> None:
        self._server: Server | None = None
        self._publishing: Publishing | None = None
        self._thinning = Thinning(self.config.picture_rate)
        self._lanes: dict[type[Event], Stream[Any]] = {
            kind: Stream(f"{self.name}.{kind.__name__}", WAITING, "drop_oldest", soon=True)
            for kind in (Image, DepthImage, TrackedFeatures, PointCloud)
        }

    async def on_startup(self) -> None:
        """Begin to listen.

        Raises:
            MissingDependencyError: foxglove is not installed.
            FatalError: The port cannot be had.
        """
        if self.checking:
            return
        loop, told = asyncio.get_running_loop(), set[str]()

        def refused(why: str) -> None:
            if why not in told and len(told) < _REFUSALS:
                told.add(why)
                with contextlib.suppress(RuntimeError):  # the run is over
                    loop.call_soon_threadsafe(self.log.warning, "somebody was refused: %s", why)

        try:
            server = await self.offload(Server, self.config, f"visnav: {self.name}", refused)
        except MissingDependencyError:
            raise
        except VisnavError as error:
            self.log.fatal("%s", error)
        self._server = server
        self._publishing = publishing = Publishing(server, self.config)
        self._small: dict[type[Event], Callable[[Any], None]] = {
            Odometry: publishing.odometry,
            PoseEstimate: publishing.estimate,
            PoseStamped: publishing.placed,
            Imu: publishing.imu,
            Score: publishing.score,
            PlannedPose: publishing.planned,
            PositionSetpoint: publishing.planned,
        }
        self.log.info("open %s in Foxglove", server.address)

    def on_announcement(self, announcement: Announcement) -> None:
        """Declare the topics for what will be said."""
        if self._publishing is not None:
            self._publishing.announced(announcement)

    async def run(self) -> None:
        """Pass on pictures and clouds beside the loop, each kind in order."""
        publishing = self._publishing
        assert publishing is not None
        large: dict[type[Event], Callable[[Any], None]] = {
            Image: publishing.image,
            DepthImage: publishing.depth,
            TrackedFeatures: publishing.features,
            PointCloud: publishing.cloud,
        }
        for kind, put in large.items():
            self.start(self._lane(self._lanes[kind], put))

    async def on_shutdown(self) -> None:
        """Stop listening."""
        if self._server is not None:
            await self.offload(self._server.close)
        if dropped := sum(lane.dropped for lane in self._lanes.values()):
            self.log.warning("%d pictures dropped: they came faster than they could go", dropped)

    @on(Image, DepthImage)
    def pictured(self, event: Image | DepthImage) -> None:
        """Have some pictures passed on."""
        kind = Image if isinstance(event, Image) else DepthImage
        if kind is DepthImage and not self.config.depth:
            return
        if self._thinning.picture(kind.__name__, event.source, event.frame_id, event.stamp):
            self._lanes[kind].offer(event)

    @on(TrackedFeatures)
    def followed(self, event: TrackedFeatures) -> None:
        """Have the features of those pictures passed on."""
        if self._thinning.belongs(event.frame_id, event.stamp):
            self._lanes[TrackedFeatures].offer(event)

    @on(PointCloud)
    def mapped(self, event: PointCloud) -> None:
        """Have a cloud passed on."""
        self._lanes[PointCloud].offer(event)

    @on(Odometry, PoseEstimate, PoseStamped, Imu, Score, PlannedPose, PositionSetpoint)
    def said(self, event: Event) -> None:
        """Pass on what is small, at once."""
        kind = type(event)
        put = self._small.get(kind) or next(
            p for k, p in self._small.items() if issubclass(kind, k)
        )
        put(event)

    @on(TrackingEvent, VehicleEvent)
    def happened(self, event: Event) -> None:
        """Tell it in words."""
        if self._publishing is not None:
            self._publishing.happened(event)

    @every(hz="time_rate")
    def tell_time(self, tick: Tick) -> None:  # noqa: ARG002
        """Tell viewers the run's time."""
        if self._server is not None:
            self._server.tell_time(self.clock.now())

    async def _lane(self, events: Stream[Any], put: Callable[[Any], None]) -> None:
        async for event in events:
            await self.offload(put, event)
