"""Rerun view as a node, and its recorder, for a worker: Rerun holds Python's lock for long.

The node numbers events, and says when they are passed on. There are two time lines: ``run``, an
event's stamp, and ``event``, the order in which they came.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    ImuAnnouncement,
    LidarScan,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    PositionSetpoint,
    Score,
    SegmentationImage,
    SensorAnnouncement,
    TrackedFeatures,
    TrackingEvent,
    VehicleAnnouncement,
    VehicleEvent,
    Wind,
)
from nodes.trajectory_files import part_name
from nodes.viewers.common import ImageSelection
from runtime import Node, Stream, on
from runtime.sensors import measured
from visnav_rerun.entities import GROUPS, EntityLog, Eye, Numbered, Plots, layout
from visnav_rerun.sdk import RerunConfig, Viewer, load
from visnav_rerun.world import World

_GATHERED = 500  # events written into a file together
_TIMEOUT = 3.0  # real seconds for a viewer to take data; else new ones are left out
_SECOND_TIMEOUT = 0.01  # real seconds for the same, after a first timeout


_NO_DISTORTION = (
    "its distortion is not shown: Rerun's pinhole has none, so points of the world do not fall on "
    "their pixels"
)


class Recorder:
    """Recording of a run.

    Args:
        name: Of the run, as the viewer lists it.
        file: To write, in mode ``save``.

    Raises:
        MissingDependencyError: rerun is not installed, or there is no screen for its window.
        VisnavError: A port is taken.
    """

    def __init__(self, config: RerunConfig, name: str, file: Path | None) -> None:
        self._config = config
        library = load()
        self._rrb = library.blueprint
        self._stream = library.RecordingStream("visnav")
        self._viewer: Viewer | None = None
        if config.mode == "save":
            self._stream.save(file)
        else:
            self._viewer = Viewer(config)
            self._stream.connect_grpc(self._viewer.data)
        self._stream.send_recording_name(name)
        self._entities = EntityLog(library, self._stream)
        self._world = World(self._entities, config)
        world, self._plots = self._world, Plots(self._entities, self._world.colours)
        self._log_functions: dict[type[Event], Callable[[Any], None]] = {
            Image: world.image,
            DepthImage: world.depth,
            SegmentationImage: world.segmentation,
            TrackedFeatures: world.features,
            LidarScan: world.scan,
            PointCloud: world.cloud,
            PoseStamped: world.pose,
            PlannedPose: world.plan,
            PositionSetpoint: world.plan,
            TrackingEvent: self._plots.logged,
            VehicleEvent: self._plots.logged,
        }
        # Put in columns, by source, before those above; the truth first: estimates are held
        # against it.
        self._columns: dict[type[Event], Callable[[str, Any], None]] = {
            Odometry: world.odometry,
            PoseEstimate: world.estimates,
            **{kind: functools.partial(self._plots.measurements, kind) for kind in GROUPS},
            Score: self._plots.scores,
        }
        self._shown_counts: tuple[int, ...] = ()
        self._closed = False
        self._behind = False
        self._left_out = 0
        self._waiting: list[Numbered[Event]] = []

    def page(self) -> str:
        """Return the address of the run's page; empty if there is none."""
        return "" if self._viewer is None else self._viewer.page

    def begin(self, announcements: Iterable[Announcement]) -> None:
        """Log the announced entities, for the whole run."""
        vehicles_first = sorted(announcements, key=lambda a: not isinstance(a, VehicleAnnouncement))
        for announcement in vehicles_first:
            match announcement:
                case VehicleAnnouncement():
                    self._world.vehicle(announcement.source)
                case EstimatorAnnouncement():
                    self._world.estimator(announcement.source)
                    self._plots.plotted.add("scores")
                case ImuAnnouncement() | SensorAnnouncement():
                    self._world.sensor(announcement)
                case BodyAnnouncement():
                    self._world.moving_body(announcement)
                case CameraAnnouncement():
                    self._world.camera(announcement)
                    if not announcement.info.is_pinhole:
                        self._plots.log_note(announcement.source, _NO_DISTORTION)
        self._show()

    def log(self, batch: Sequence[Numbered[Event]]) -> None:
        """Log events, in the order of arrival; a file's are gathered, for fewer heads of rows."""
        if self._viewer is not None and not self._viewer_keeps_up():
            self._left_out += len(batch)
            return
        self._waiting += batch
        if self._viewer is None and len(self._waiting) < _GATHERED:
            return
        batch, self._waiting = self._waiting, []
        self._log(batch)

    def _log(self, batch: Sequence[Numbered[Event]]) -> None:
        for _, event in batch:
            if isinstance(event, TrackedFeatures):
                self._world.vehicles.tracked(event)  # before the estimates are placed
        by_source: dict[type[Event], dict[str, list[Any]]] = {kind: {} for kind in self._columns}
        for number, event in batch:
            kind = next((kind for kind in by_source if isinstance(event, kind)), None)
            if kind is not None:
                by_source[kind].setdefault(event.source, []).append((number, event))
        for kind, sources in by_source.items():
            for source, events in sources.items():
                self._columns[kind](source, events)
                if kind is Wind:
                    self._world.wind(source, events)
        for number, event in batch:
            self._entities.now = number, event.stamp
            log_event = next(
                (
                    log_event
                    for kind, log_event in self._log_functions.items()
                    if isinstance(event, kind)
                ),
                None,
            )
            if log_event is not None:
                log_event(event)
        self._show()

    def left_out(self) -> int:
        """Return how many events were not logged because a viewer stood still or had gone."""
        return self._left_out

    def close(self) -> str:
        """Write the rest, and end; return a viewer's trouble, or raise a file's `RuntimeError`."""
        if self._closed:
            return ""
        self._closed = True
        self._log(self._waiting)
        self._world.finish()
        self._show(self._eye())
        if self._viewer is None:
            self._stream.flush()
            self._stream.disconnect()
            return ""
        problem = ""
        if self._viewer_keeps_up():
            self._stream.disconnect()
        else:  # a window that was closed, or a viewer that stands still: it would wait for that
            problem = self._viewer.last_words() or "it took nothing any more"
        self._viewer.close()
        return problem

    def _viewer_keeps_up(self) -> bool:
        """Return whether a viewer takes the logged data in time; if late before, wait briefly."""
        try:
            self._stream.flush(timeout_sec=_SECOND_TIMEOUT if self._behind else _TIMEOUT)
        except RuntimeError:
            self._behind = True
        else:
            self._behind = False
        return not self._behind

    def _show(self, eye: Eye | None = None) -> None:
        images = self._world.images
        counts = (
            len(self._world.trails),
            len(self._plots.plotted),
            *(len(kinds) for kinds in images.values()),
        )
        if counts == self._shown_counts and eye is None:
            return
        self._shown_counts = counts
        plots = self._plots.titles()
        self._stream.send_blueprint(layout(self._rrb, self._world.trails, images, plots, eye))

    def _eye(self) -> Eye | None:
        """Return an eye above the whole flight, from the south-west."""
        low, high = self._world.bounds
        if self._config.mode != "save" or not np.isfinite(low).all():
            return None
        centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 5.0)
        x, y, z = centre.tolist()
        return (x - 0.8 * size, y - 0.45 * size, z - size), (x, y, z)


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
        self._has_begun = False
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
        """Queue selected images."""
        self._received += 1
        kind = type(event).__name__
        if self._selection.select(kind, event.source, event.frame_id, event.stamp):
            self._large.offer((self._received, event))

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Queue the features of the selected images."""
        self._received += 1
        if self._selection.selected(event.frame_id, event.stamp):
            self._large.offer((self._received, event))

    @on(PointCloud, LidarScan)
    def point_clouds(self, event: PointCloud | LidarScan) -> None:
        """Queue clouds, and turns of lidars."""
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
        *measured(),
    )
    def measurements(self, event: Event) -> None:
        """Queue a small event."""
        self._received += 1
        self._small.offer((self._received, event))

    async def run(self) -> None:
        """Pass on the waiting events; in lockstep the run continues for one period meanwhile."""
        if self._recorder is None:
            return
        await self._begin()
        period = 1.0 / self.config.update_rate
        while True:
            batch = self._next_batch()
            if batch:
                await self._recorder.call_for(period, Recorder.log, batch)
            else:
                await self.clock.sleep(period)

    async def on_shutdown(self) -> None:
        """Pass on the rest, and close the file."""
        if self._recorder is None:
            return
        await self._begin()
        while batch := self._next_batch():
            await self._recorder.call_for(0.0, Recorder.log, batch)
        if problem := await self._recorder.call_for(0.0, Recorder.close):
            self.log.warning("the viewer has not got everything: %s", problem)
        dropped = self._large.dropped + self._small.dropped
        dropped += await self._recorder.call_for(0.0, Recorder.left_out)
        if dropped:
            self.log.warning(
                "%d of %d events dropped: the view was too slow", dropped, self._received
            )
        if self.config.mode == "save" and self.out is not None:
            self.log.info("%s: rerun opens it", part_name(self, self.config.file))

    async def _begin(self) -> None:
        if not self._has_begun:
            self._has_begun = True
            await self._recorder.call_for(0.0, Recorder.begin, self._announcements)

    def _next_batch(self) -> list[Numbered[Event]]:
        batch = [
            stream.receive_nowait()
            for stream in (self._large, self._small)
            for _ in range(min(stream.statistics().buffered, _PACK))
        ]
        batch.sort(key=lambda numbered: numbered[0])
        return batch
