"""Events to Rerun. For a worker's process, because the library holds Python's lock for long.

    recorder = await self.worker(Recorder, config, name, file)
    await recorder.call(Recorder.begin, announcements)
    await recorder.call(Recorder.log, batch)

There are two time lines: ``run``, an event's stamp, and ``event``, the order in which they came.
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
from nodes.viewers.rerun.entities import EntityLog, Eye, Numbered, layout
from nodes.viewers.rerun.plots import GROUPS, Plots
from nodes.viewers.rerun.sdk import RerunConfig, Viewer, load
from nodes.viewers.rerun.world import World

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
        self._puts: dict[type[Event], Callable[[Any], None]] = {
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
        self._shown: tuple[int, ...] = ()
        self._closed = False
        self._behind = False
        self._left_out = 0
        self._waiting: list[Numbered[Event]] = []

    def page(self) -> str:
        """Return the address of the run's page; empty if there is none."""
        return "" if self._viewer is None else self._viewer.page

    def begin(self, announcements: Iterable[Announcement]) -> None:
        """Put the announced entities, for the whole run."""
        vehicles_first = sorted(announcements, key=lambda a: not isinstance(a, VehicleAnnouncement))
        for each in vehicles_first:
            match each:
                case VehicleAnnouncement():
                    self._world.vehicle(each.source)
                case EstimatorAnnouncement():
                    self._world.estimator(each.source)
                    self._plots.plotted.add("scores")
                case ImuAnnouncement() | SensorAnnouncement():
                    self._world.sensor(each)
                case BodyAnnouncement():
                    self._world.moving_body(each)
                case CameraAnnouncement():
                    self._world.camera(each)
                    if not each.info.is_pinhole:
                        self._plots.note(each.source, _NO_DISTORTION)
        self._show()

    def log(self, batch: Sequence[Numbered[Event]]) -> None:
        """Put events, in the order of arrival; a file's are gathered, for fewer heads of rows."""
        if self._viewer is not None and not self._taken():
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
        together: dict[tuple[type[Event], str], list[Any]] = {}
        for number, event in batch:
            kind = next((kind for kind in self._columns if isinstance(event, kind)), None)
            if kind is not None:
                together.setdefault((kind, event.source), []).append((number, event))
        for kind, put_columns in self._columns.items():
            for (found, source), events in together.items():
                if found is kind:
                    put_columns(source, events)
                    if kind is Wind:
                        self._world.wind(source, events)
        for number, event in batch:
            self._entities.now = number, event.stamp
            put = next((put for kind, put in self._puts.items() if isinstance(event, kind)), None)
            if put is not None:
                put(event)
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
        trouble = ""
        if self._taken():
            self._stream.disconnect()
        else:  # a window that was closed, or a viewer that stands still: it would wait for that
            trouble = self._viewer.last_words() or "it took nothing any more"
        self._viewer.close()
        return trouble

    def _taken(self) -> bool:
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
        found = (
            len(self._world.trails),
            len(self._plots.plotted),
            *(len(kinds) for kinds in images.values()),
        )
        if found == self._shown and eye is None:
            return
        self._shown = found
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
