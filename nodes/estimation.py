"""What estimators have in common: which camera they read, where it sits, what they say.

Not here: how a pose is computed (`nodes.visual_odometry` and its neighbours), and how good it is
(`nodes.evaluation`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

import msgspec
import numpy as np
import numpy.typing as npt
from typing_extensions import TypeVar

from events import (
    Announcement,
    Armed,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    PoseEstimate,
    TakenOff,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
    VehicleAnnouncement,
    VehicleEvent,
)
from events.poses import pose_matrix, pose_tuples
from runtime import Node, NodeConfig, Output, on
from runtime.errors import suggest
from runtime.units import Latency

Floats = npt.NDArray[np.float64]

WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""One core for each estimator: the sums of linear algebra then have one order, and one result."""


class RgbdFrame(NamedTuple):
    """A colour (or grey) picture and the depth of the same exposure."""

    image: Image
    depth: DepthImage


class Tracked(Protocol):
    """What a tracker says of one picture.

    Attributes:
        pose: The optical camera now, in the optical camera at the first picture; metres (or the
            tracker's own unit), shape (4, 4).
        lost: Whether the pose is not known; `pose` is then the last one that was.
        reason: Why.
        points: float32 pixels, shape (n, 2): what was followed.
        inliers: bool, shape (n,): what agrees with the pose.
    """

    @property
    def pose(self) -> Floats: ...  # noqa: D102  # above
    @property
    def lost(self) -> bool: ...  # noqa: D102
    @property
    def reason(self) -> str: ...  # noqa: D102
    @property
    def points(self) -> npt.NDArray[np.float32]: ...  # noqa: D102
    @property
    def inliers(self) -> npt.NDArray[np.bool_]: ...  # noqa: D102


class EstimatorConfig(NodeConfig):
    """Settings that all estimators have.

    Attributes:
        origin: ``announced``: the estimates are in ``map``, and begin at the pose at which the
            vehicle said it stands, if that is known to be true (else as ``start``; see
            `Estimator`). ``start``: they are in ``odom``, which is where the body is at the first
            image with a pose.
        latency: Seconds on the run's clock that one estimate takes.
    """

    origin: Literal["announced", "start"] = "announced"
    latency: Latency = Latency(0.015)  # immutable


C = TypeVar("C", bound=EstimatorConfig, default=EstimatorConfig)


class Estimator(Node[C], ABC):
    """Base of the nodes that turn pictures into poses.

    A subclass declares its input as ``frames`` (of one camera), names in `needs` what that camera
    must give, starts its tracker in `on_ready`, when `the_camera` is known, and in `run` calls
    `publish` with what the tracker says.

    The frame of the estimates is chosen once, with the first pose. It is ``map`` if the announced
    pose of the vehicle was true for the image at which the tracker's own poses begin:

    - the node was there when the run began: it is not a restarted one;
    - the vehicle had not been armed (and had not taken off) at that image's stamp;
    - the vehicle takes commands (its announced control rate is above 0), so that it stands until it
      says `Armed`; or, for a recorded vehicle, which may move from the start on and say nothing,
      the image is not later than a camera's period and latency after the announcement;
    - the estimates are in metres: the estimator is not scale-free.

    Otherwise it is ``odom``, whose origin is the body at that image, and after a restart
    ``odom_1``, ``odom_2``, … A restarted node says `TrackingLost`, then `TrackingRegained`.
    """

    needs: frozenset[str] = frozenset()
    """Kinds of image: all must be there; ``grey`` is satisfied by ``rgb`` too."""
    method: str = ""
    scale_free: bool = False

    estimates = Output(PoseEstimate)
    tracking = Output(TrackingEvent)
    features = Output(TrackedFeatures)

    camera: CameraAnnouncement | None = None
    _vehicles: tuple[VehicleAnnouncement, ...] = ()
    _cameras: tuple[str, ...] = ()
    _mount: Mount | None = None
    _lost = False
    _moving: Mapping[str, int] = MappingProxyType({})

    def announce(self) -> Iterable[Announcement]:
        """Say that there will be estimates."""
        yield EstimatorAnnouncement(
            stamp=0, source=self.name, method=self.method, scale_free=self.scale_free
        )

    def on_announcement(self, announcement: Announcement) -> None:
        """Take the first camera that gives what is needed, or the one that the file names."""
        if isinstance(announcement, VehicleAnnouncement):
            self._vehicles += (announcement,)
        if not isinstance(announcement, CameraAnnouncement) or self.camera is not None:
            return
        self._cameras += (announcement.source,)
        named = self.sources.get("frames")
        if named is not None and named != announcement.source:
            return
        gives = {*announcement.images} | ({"grey"} if "rgb" in announcement.images else set())
        if lacking := self.needs - gives:
            if named is None:
                return
            raise ValueError(
                f"expected a camera with {', '.join(sorted(self.needs))} images, "
                f"found none with {', '.join(sorted(lacking))}"
            )
        self.camera = announcement
        self.narrow("frames", announcement.source)

    @on(Armed, TakenOff)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Note since when a vehicle may have left the pose that it announced."""
        self._moving = {event.source: event.stamp, **self._moving}

    def check(self) -> Iterable[str]:
        """Say if no camera gives what is needed."""
        if self.camera is None:
            yield self._lacking()

    @abstractmethod
    async def run(self) -> None:
        """Track the images."""

    def the_camera(self) -> CameraAnnouncement:
        """Return the camera to read.

        Raises:
            FatalError: No camera gives what is needed.
        """
        if self.camera is None:
            self.log.fatal("%s", self._lacking())
        return self.camera

    def _lacking(self) -> str:
        named = self.sources.get("frames")
        called = f" called {named}" if named else ""
        found = ", ".join(self._cameras) or "none"
        return (
            f"expected a camera with {', '.join(sorted(self.needs))} images{called}, "
            f"found {found}{suggest(named or '', self._cameras)}"
        )

    def publish(self, image: Image, tracked: Tracked, origin: int | None = None) -> None:
        """Say what a tracker found in an image.

        Args:
            image: It.
            tracked: What the tracker says of it.
            origin: Stamp (ns) of the image at which the tracker's poses begin; if `None`, that of
                the first image that is published with a pose.
        """
        if self.restarts and self._mount is None and not self._lost:
            self._lost = True
            reason = f"restarted: poses are in {self._odom()} from here on"
            self.tracking.send(TrackingLost(stamp=image.stamp, source=self.name, reason=reason))
        self.features.send(
            TrackedFeatures(
                stamp=image.stamp,
                source=self.name,
                frame_id=image.frame_id,
                points=tracked.points,
                inliers=tracked.inliers,
            )
        )
        if tracked.lost and not self._lost:
            self.log.warning("lost: %s", tracked.reason or "no reason given")
            self.tracking.send(
                TrackingLost(stamp=image.stamp, source=self.name, reason=tracked.reason)
            )
        elif self._lost and not tracked.lost:
            self.log.info("regained %s", tracked.reason)
            self.tracking.send(TrackingRegained(stamp=image.stamp, source=self.name))
        self._lost = tracked.lost
        if not tracked.lost:
            if self._mount is None:
                self._mount = self._mounting(image.stamp if origin is None else origin)
            self.estimates.send(self._mount.estimate(image.stamp, self.name, tracked.pose))

    def _mounting(self, origin: int) -> Mount:
        """Return the mount for a tracker whose poses begin at an image of this stamp."""
        camera = self.the_camera()
        carriers = (v for v in self._vehicles if camera.source.startswith(f"{v.source}/"))
        vehicle = next(carriers, None) if self.config.origin == "announced" else None
        if vehicle is not None and not self.scale_free and not self._stood(vehicle, origin):
            self.log.warning(
                "the announced pose of %s is not known to hold at %.3f s, where tracking begins: "
                "estimates are in %s",
                vehicle.source,
                origin / 1e9,
                self._odom(),
            )
            vehicle = None
        return Mount.of(camera, None if self.scale_free else vehicle, self._odom())

    def _stood(self, vehicle: VehicleAnnouncement, stamp: int) -> bool:
        """Tell whether a vehicle is known to have been at its announced pose at a time (ns)."""
        camera = self.the_camera()
        if self.restarts or self._moving.get(vehicle.source, stamp) < stamp:
            return False
        first = camera.latency + (1.0 / camera.rate if camera.rate > 0 else 0.0)
        return vehicle.control_rate > 0 or stamp - vehicle.stamp <= first * 1e9

    def _odom(self) -> str:
        """Return the frame of an estimator that does not know where it began."""
        return f"odom_{self.restarts}" if self.restarts else "odom"


class Mount(msgspec.Struct, frozen=True, eq=False):
    """Where a camera sits on a body, and where the body was at the first picture.

    Attributes:
        frame_id: Parent frame of the estimates.
        child_frame_id: The body.
        start: The body at the first picture in the parent frame, shape (4, 4).
        camera: The optical frame in the body's, shape (4, 4).
    """

    frame_id: str
    child_frame_id: str
    start: Floats
    camera: Floats

    @classmethod
    def of(
        cls, camera: CameraAnnouncement, vehicle: VehicleAnnouncement | None, frame_id: str = "odom"
    ) -> Mount:
        """Make the mount of an announced camera.

        Args:
            camera: It.
            vehicle: Whose announced pose the body had at the first image; if `None`, where that
                was is unknown.
            frame_id: Parent frame of the estimates if it is.
        """
        return cls(
            frame_id=frame_id if vehicle is None else "map",
            child_frame_id=camera.parent_frame_id,
            start=np.eye(4)
            if vehicle is None
            else pose_matrix(vehicle.position, vehicle.orientation),
            camera=pose_matrix(camera.position, camera.orientation),
        )

    def estimate(self, stamp: int, source: str, pose: Floats) -> PoseEstimate:
        """Return the body's pose.

        Args:
            stamp: Of the picture (ns).
            source: Who says it.
            pose: The optical camera in its own first frame, shape (4, 4).
        """
        body = self.start @ self.camera @ pose @ np.linalg.inv(self.camera)
        position, orientation = pose_tuples(body)
        return PoseEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            position=position,
            orientation=orientation,
        )
