"""Measurements of a run: estimators and their errors, paths, and images with features.

Made from the events that pass while a client is connected; errors are those that a node sends as
`Score`, and nothing is judged here.
"""

from __future__ import annotations

import collections
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from events import (
    CameraAnnouncement,
    EstimatorAnnouncement,
    Event,
    Image,
    Odometry,
    PoseEstimate,
    Score,
    TrackedFeatures,
    TrackingLost,
    TrackingRegained,
    Vector3,
)
from events.announcements import Vehicles
from events.frames import rotate
from events.geometry import Pose, relative
from runtime.errors import CommandError, expect_known
from runtime.run.run_state import RunState
from runtime.time.clock import SECOND
from runtime.tools.monitor.protocol import Points

GAP = SECOND // 2
"""Silence that counts as lost, nanoseconds; as an evaluation's, if its file sets no other."""

MOST_POINTS = 500  # points of a path at most
_RECENT = 1000  # true poses of a vehicle that are kept, for estimates that come late
_IMAGES = 4  # newest images of a camera that are kept, for features that come late


class Path:
    """Path as a list of places; the more they become, the larger is the time between them."""

    def __init__(self) -> None:
        self.points: Points = []
        self._spacing, self._next = SECOND // 20, 0

    def due(self, stamp: int) -> bool:
        """Return whether to add a place of this stamp (ns)."""
        return stamp >= self._next

    def add(self, stamp: int, *place: float) -> None:
        """Add a place, rounded to millimetres."""
        self.points.append(tuple(round(coordinate, 3) for coordinate in place))
        if len(self.points) > MOST_POINTS:
            del self.points[1::2]
            self._spacing *= 2
        self._next = stamp + self._spacing


class Estimator:
    """State of an estimator since the monitor was opened.

    Attributes:
        lost: Why it has lost track, by its own word; `None` if it has not.
        received_at: Arrival of its last estimate, on the run's clock (ns); `None` before.
        latency: Of that estimate, nanoseconds.
    """

    def __init__(self, scale_free: bool) -> None:
        self.lost: str | None = None
        self.received_at: int | None = None
        self.latency = 0
        self.path = Path()
        self.scale_free = scale_free
        self._origin: tuple[Pose, Pose] | None = None
        """The true pose at the first estimate, and that estimate."""

    def tracking(self, now: int) -> str:
        """Return in words whether it has lost track, by its word or by silence."""
        if self.lost is not None:
            return f"lost: {self.lost}" if self.lost else "lost"
        if self.received_at is None:
            return "silent"
        silent = now - self.received_at
        return f"lost: silent for {silent / SECOND:.1f} s" if silent > GAP else "tracking"

    def add(self, event: PoseEstimate, truth: Pose | None, camera: Vector3 = (0, 0, 0)) -> None:
        """Add an estimate's place, aligned at the first estimate if it is not in ``map``.

        Args:
            camera: Place on the body (m) of the camera at which it is aligned, as in an
                evaluation, if free of scale.
        """
        north, east, _ = event.position
        if self.scale_free:
            if truth is not None:  # aligned when drawn
                x, y, _ = rotate(event.orientation, camera)
                u, v, _ = rotate(truth[1], camera)
                true = truth[0][1] + v, truth[0][0] + u
                self.path.add(event.stamp, east + y, north + x, *true, v, u)
            return
        if event.frame_id != "map" and truth is not None:
            pose = event.position, event.orientation
            base, first = self._origin = self._origin or (truth, pose)
            moved = rotate(base[1], relative(first, pose)[0])
            north, east = base[0][0] + moved[0], base[0][1] + moved[1]
        self.path.add(event.stamp, east, north)

    def points_to_draw(self) -> Points:
        """Return its path; if free of scale, aligned by the similarity that fits best."""
        if not self.scale_free or not self.path.points:
            return list(self.path.points)
        rows = np.array(self.path.points)
        estimated, true, lever = (rows[:, ::2] + 1j * rows[:, 1::2]).T
        centred = estimated - estimated.mean()
        factor = np.vdot(centred, true) / max(np.vdot(centred, centred).real, 1e-12)
        aligned = factor * centred + true.mean() - lever
        return list(
            zip(aligned.real.round(3).tolist(), aligned.imag.round(3).tolist(), strict=True)
        )


class Measured:
    """Estimators, vehicles and cameras of a run, since the monitor was opened.

    Attributes:
        follow: Functions to be called with events of some types, and the names of their outputs.
    """

    def __init__(self, state: RunState) -> None:
        self._state = state
        self._truths: dict[str, tuple[Path, collections.deque[Odometry]]] = {}  # by vehicle
        self._estimators: dict[str, Estimator] = {}
        self._scores: dict[tuple[str, str], float] = {}  # by estimator and metric
        self._images: dict[str, collections.deque[Image]] = {}
        self._features: dict[str, TrackedFeatures] = {}  # by estimator
        self.follow: dict[type[Event], Callable[[str, Any], None]] = {
            Image: self._image,
            Odometry: self._odometry,
            PoseEstimate: self._estimate,
            Score: self._score,
            TrackedFeatures: self._tracked,
            TrackingLost: self._lost,
            TrackingRegained: self._lost,
        }

    @functools.cached_property
    def _vehicles(self) -> Vehicles:
        vehicles = Vehicles()
        for announcement in self._state.announcements:
            vehicles.announced(announcement)
            if isinstance(announcement, EstimatorAnnouncement):
                self._estimators.setdefault(announcement.source, Estimator(announcement.scale_free))
        return vehicles

    def _odometry(self, _: str, event: Odometry) -> None:
        names = self._vehicles.names
        if names and event.source not in names:  # an estimate of others
            return
        truth = self._truths.get(event.source)
        if truth is None:
            self._vehicles.add(event.source)
            truth = self._truths[event.source] = Path(), collections.deque(maxlen=_RECENT)
        path, recent = truth
        recent.append(event)
        if path.due(event.stamp):
            path.add(event.stamp, event.position[1], event.position[0])

    def _estimator(self, name: str) -> Estimator:
        _ = self._vehicles  # which knows those that are announced
        return self._estimators.setdefault(name, Estimator(scale_free=False))

    def _estimate(self, _: str, event: PoseEstimate) -> None:
        estimator = self._estimator(event.source)
        estimator.received_at = now = self._state.clock.now()
        estimator.latency = now - event.stamp
        if estimator.path.due(event.stamp):
            estimator.add(event, self._truth(event), self._camera(event.source))

    def _camera(self, estimator: str) -> Vector3:
        """Return the place on the body of the camera in whose images it tracks features."""
        eye = self._vehicles.camera_of(estimator)
        for announced in self._state.announcements if eye else ():
            if isinstance(announced, CameraAnnouncement) and announced.source == eye:
                return announced.position
        return 0.0, 0.0, 0.0

    def _truth(self, event: PoseEstimate) -> Pose | None:
        truths = self._truths.get(self._vehicles.of(event.source))
        for true in reversed(truths[1] if truths is not None else ()):
            if true.stamp <= event.stamp:
                return true.position, true.orientation
        return None

    def _lost(self, _: str, event: TrackingLost | TrackingRegained) -> None:
        reason = event.reason if isinstance(event, TrackingLost) else None
        self._estimator(event.source).lost = reason

    def _score(self, _: str, event: Score) -> None:
        self._scores[event.subject, event.metric] = event.value

    def _tracked(self, _: str, event: TrackedFeatures) -> None:
        self._vehicles.tracked(event)
        self._features[event.source] = event

    def _image(self, name: str, event: Image) -> None:
        camera = f"{name}: {event.source}"
        if camera not in self._images:
            self._images[camera] = collections.deque(maxlen=_IMAGES)
        self._images[camera].append(event)

    # Parts of a snapshot.

    def rows(self) -> list[tuple[object, ...]]:
        """Return the values of the estimators' table."""
        _ = self._vehicles
        now, score = self._state.clock.now(), self._scores.get
        return [
            (
                name,
                estimator.tracking(now),
                score((name, "ate_rmse")),
                score((name, "ate_percent")),
                None if estimator.received_at is None else estimator.latency / 1e6,
            )
            for name, estimator in self._estimators.items()
        ]

    def paths(self) -> dict[str, Points]:
        """Return the paths of vehicles and estimators: metres east, metres north."""
        true = {f"{name}: truth": list(path.points) for name, (path, _) in self._truths.items()}
        return true | {
            name: estimator.points_to_draw() for name, estimator in self._estimators.items()
        }

    def cameras(self) -> list[str]:
        """Return the cameras that have sent images."""
        return sorted(self._images)

    def image(self, camera: str) -> tuple[Image, list[TrackedFeatures]]:
        """Return the newest image with features that is kept, or else the newest, and its features.

        Raises:
            CommandError: The camera has sent no image.
        """
        message = f"expected a camera that has sent images, found {camera!r}"
        expect_known(camera, self._images, message, CommandError)
        for image in reversed(self._images[camera]):
            key = image.stamp, image.frame_id
            features = [f for f in self._features.values() if (f.stamp, f.frame_id) == key]
            if features:
                return image, features
        return self._images[camera][-1], []
