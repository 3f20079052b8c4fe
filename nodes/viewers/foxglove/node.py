"""Foxglove server as a node: its events, and their way to the server."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

from events import Announcement, DepthImage, Event, Image, LidarScan, PointCloud, TrackedFeatures
from nodes.viewers.common import ImageSelection
from nodes.viewers.foxglove.publishing import SMALL, Publishing
from nodes.viewers.foxglove.server import FoxgloveConfig, Server
from runtime import Node, Stream, Tick, every, on
from runtime.errors import MissingDependencyError, VisnavError

_QUEUED = (Image, DepthImage, PointCloud, LidarScan, TrackedFeatures)
"""Events whose messages take long to make."""
WAITING = 8  # images of a kind waiting to be passed on; the oldest is dropped, and counted
_REFUSALS = 10  # different refusals to log, at most


class FoxgloveServer(Node[FoxgloveConfig]):
    """Live view of a run in Foxglove: *Open connection*, ``ws://localhost:8765``.

    ::

        [[nodes]]
        name = "foxglove"
        type = "FoxgloveServer"

    Topics, types and frames are ROS 2's, as of the bridge and a recording; paths, bodies, features
    and the log are Foxglove's own. Announced sources have topics from the start, others from their
    first event. Late viewers get fixed transforms, clouds and paths.
    """

    reads_truth = "showing"

    def __init__(self) -> None:
        self._server: Server | None = None
        self._publishing: Publishing | None = None
        self._selection = ImageSelection(self.config.image_rate)
        self._queues: dict[type[Event], Stream[Any]] = {
            kind: Stream(f"{self.name}.{kind.__name__}", WAITING, "drop_oldest", soon=True)
            for kind in _QUEUED
        }

    async def on_startup(self) -> None:
        """Begin to listen; a `FatalError` if the port is taken."""
        if self.checking:
            return
        loop, logged = asyncio.get_running_loop(), set[str]()

        def refused(why: str) -> None:
            if why not in logged and len(logged) < _REFUSALS:
                logged.add(why)
                with contextlib.suppress(RuntimeError):  # the run is over
                    loop.call_soon_threadsafe(self.log.warning, "somebody was refused: %s", why)

        try:
            server = await self.offload(Server, self.config, f"visnav: {self.name}", refused)
        except MissingDependencyError:
            raise
        except VisnavError as error:
            self.log.fatal("%s", error)
        self._server = server
        self._publishing = await self.offload(Publishing, server, self.config)
        self.log.info("open %s in Foxglove", server.address)

    def on_announcement(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        if self._publishing is not None:
            self._publishing.announced(announcement)

    async def run(self) -> None:
        """Pass on images and point clouds beside the loop, each kind in order."""
        publishing = self._publishing
        assert publishing is not None
        publishing.begin()
        for kind, events in self._queues.items():
            put = publishing.features if kind is TrackedFeatures else publishing.put
            self.start(self._pass_on(events, put))

    async def on_shutdown(self) -> None:
        """Stop listening."""
        if self._server is not None:
            await self.offload(self._server.close)
        if dropped := sum(queue.dropped for queue in self._queues.values()):
            self.log.warning("%d images dropped: they came faster than they could go", dropped)

    @on(Image, DepthImage)
    def images(self, event: Image | DepthImage) -> None:
        """Pass on some images, beside the loop."""
        kind = Image if isinstance(event, Image) else DepthImage
        if kind is DepthImage and not self.config.depth:
            return
        if self._selection.select(kind.__name__, event.source, event.frame_id, event.stamp):
            self._queues[kind].offer(event)

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Pass on the features of those images."""
        if self._publishing is not None:
            self._publishing.put(event)
        if self._selection.selected(event.frame_id, event.stamp):
            self._queues[TrackedFeatures].offer(event)

    @on(PointCloud, LidarScan)
    def point_clouds(self, event: PointCloud | LidarScan) -> None:
        """Pass on a point cloud, or a turn of a lidar."""
        self._queues[LidarScan if isinstance(event, LidarScan) else PointCloud].offer(event)

    @on(*SMALL)
    def measurements(self, event: Event) -> None:
        """Pass on small events at once."""
        if self._publishing is not None:
            self._publishing.put(event)

    @every(hz="clock_rate")
    def send_time(self, tick: Tick) -> None:  # noqa: ARG002
        """Send the run's time to viewers."""
        if self._server is not None:
            self._server.send_time(self.clock.now())

    async def _pass_on(self, events: Stream[Any], put: Callable[[Any], None]) -> None:
        async for event in events:
            await self.offload(put, event)
