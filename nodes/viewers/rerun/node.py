"""Rerun view as a node: its events, their number, and the times of passing them on."""

from __future__ import annotations

from typing import Any

from events import (
    Announcement,
    DepthImage,
    Event,
    Image,
    LidarScan,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    PositionSetpoint,
    Score,
    SegmentationImage,
    TrackedFeatures,
    TrackingEvent,
    VehicleEvent,
)
from events.sensors import MEASURED
from nodes.trajectory.table import part_name
from nodes.viewers.common import ImageSelection
from nodes.viewers.rerun.entities import Numbered
from nodes.viewers.rerun.recorder import Recorder
from nodes.viewers.rerun.sdk import RerunConfig
from runtime import Node, Stream, on

_LARGE, _SMALL = 256, 16384  # events waiting to be passed on: images and clouds, and the rest
_PACK = 2048  # events passed on at once, at most


class RerunView(Node[RerunConfig]):
    """View of a run in Rerun, or a file for Rerun.

    ::

        [[nodes]]
        name = "view"
        type = "RerunView"

    World, vehicles, cameras with images, paths, estimates, clouds, errors and IMU have places in a
    ready layout. First in the file, it also gets the last events of other nodes, such as a
    mapping's cloud.
    """

    reads_truth = "showing"

    def __init__(self) -> None:
        self._announcements: list[Announcement] = []
        self._received = 0
        self._recorder: Any = None
        self._begun = False
        self._selection = ImageSelection(self.config.image_rate)
        self._large: Stream[Numbered[Event]] = Stream(f"{self.name}.large", _LARGE, "drop_oldest")
        self._small: Stream[Numbered[Event]] = Stream(f"{self.name}.small", _SMALL, "drop_oldest")

    async def on_startup(self) -> None:
        """Start the process of the recorder."""
        config, file = self.config, None
        if config.mode == "save":
            if self.out is None:
                if not self.checking:
                    self.log.warning("the run writes no files, so there is nothing to view")
                return
            file = self.out / part_name(self, config.file)
            self.out.mkdir(parents=True, exist_ok=True)
        name = self.name if self.out is None else self.out.name
        self._recorder = await self.worker(Recorder, config, name, file)
        if page := await self._recorder.call_for(0.0, Recorder.page):
            self.log.info("open %s", page)

    def on_announcement(self, announcement: Announcement) -> None:
        """Store an announcement for the recorder."""
        self._announcements.append(announcement)

    @on(Image, DepthImage, SegmentationImage)
    def images(self, event: Image | DepthImage | SegmentationImage) -> None:
        """Keep some images."""
        self._received += 1
        kind = type(event).__name__
        if self._selection.select(kind, event.source, event.frame_id, event.stamp):
            self._large.offer((self._received, event))

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Keep the features of those images."""
        self._received += 1
        if self._selection.selected(event.frame_id, event.stamp):
            self._large.offer((self._received, event))

    @on(PointCloud, LidarScan)
    def point_clouds(self, event: PointCloud | LidarScan) -> None:
        """Keep clouds, and turns of lidars."""
        self._received += 1
        self._large.offer((self._received, event))

    @on(
        Odometry,
        PoseStamped,
        PoseEstimate,
        PlannedPose,
        PositionSetpoint,
        Score,
        TrackingEvent,
        VehicleEvent,
        *MEASURED,
    )
    def measurements(self, event: Event) -> None:
        """Queue a small event."""
        self._received += 1
        self._small.offer((self._received, event))

    async def run(self) -> None:
        """Pass on the waiting events; in lockstep the run goes on for one period meanwhile."""
        if self._recorder is None:
            return
        await self._begin()
        period = 1.0 / self.config.update_rate
        while True:
            batch = self._take()
            if batch:
                await self._recorder.call_for(period, Recorder.log, batch)
            else:
                await self.clock.sleep(period)

    async def on_shutdown(self) -> None:
        """Pass on the rest, and close the file."""
        if self._recorder is None:
            return
        await self._begin()
        while batch := self._take():
            await self._recorder.call_for(0.0, Recorder.log, batch)
        if trouble := await self._recorder.call_for(0.0, Recorder.close):
            self.log.warning("the viewer has not got everything: %s", trouble)
        dropped = self._large.dropped + self._small.dropped
        dropped += await self._recorder.call_for(0.0, Recorder.left_out)
        if dropped:
            self.log.warning(
                "%d of %d events dropped: the view was too slow", dropped, self._received
            )
        if self.config.mode == "save" and self.out is not None:
            self.log.info("%s: rerun opens it", part_name(self, self.config.file))

    async def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            await self._recorder.call_for(0.0, Recorder.begin, self._announcements)

    def _take(self) -> list[Numbered[Event]]:
        batch = [
            stream.receive_nowait()
            for stream in (self._large, self._small)
            for _ in range(min(stream.statistics().buffered, _PACK))
        ]
        batch.sort(key=lambda each: each[0])
        return batch
