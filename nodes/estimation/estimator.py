"""The base of all estimators: choice of the camera, outputs, and the frame of the estimates.

Poses are computed in the subclasses (`nodes.visual_odometry` and others), and judged in
`nodes.evaluation`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

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
from nodes.estimation.mount import Mount
from runtime import Node, NodeConfig, Output, on
from runtime.errors import suggest
from runtime.units import Latency

WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of an estimator's process: one core for each.

The sums of linear algebra then always have the same order, and so the same result.
"""


class RgbdFrame(NamedTuple):
    """A colour (or grey) image and the depth of the same exposure."""

    image: Image
    depth: DepthImage


class EstimatorConfig(NodeConfig):
    """Settings of every estimator.

    Attributes:
        origin: ``announced``: the estimates are in ``map`` and start at the pose that the vehicle
            announced, if that is known to be true (else as ``start``; see `Estimator`). ``start``:
            they are in ``odom``, whose origin is the body at the first image with a pose.
        latency: Time on the run's clock from the arrival of an image to its estimate.
    """

    origin: Literal["announced", "start"] = "announced"
    latency: Latency = Latency(0.015)  # immutable


C = TypeVar("C", bound=EstimatorConfig, default=EstimatorConfig)


class Estimator(Node[C], ABC):
    """Base of the nodes that estimate poses from images.

    A subclass declares its input as ``frames``, a `Bundle` of one camera's images; names in `needs`
    the kinds of image that it takes; starts its tracker in `on_ready`, when `the_camera` is known;
    and in `run` calls `publish` with a `TrackingResult` for each image::

        class MyEstimator(Estimator):
            needs = frozenset({"grey", "depth"})
            frames = Bundle(RgbdFrame, keep="latest")

            async def on_ready(self) -> None:
                info, latency = self.the_camera().info, self.config.latency
                self.tracker = await self.worker(MyTracker, info, latency=latency)

            async def run(self) -> None:
                async for image, depth in self.frames:
                    args = image.stamp, image.data, depth.data
                    self.publish(image, await self.tracker.call(MyTracker.track, *args))

    The tracker gives poses of the optical camera (x right, y down, z forward) in the optical camera
    at its first image. What is sent is the pose of the body (FRD) that carries the camera, as a
    `PoseEstimate`; its stamp is on the clock of the IMU (`exposed_at`).

    **Frame and alignment.** The `frame_id` of the estimates, chosen once with the first pose, says
    what is known about their origin, and so how `nodes.evaluation` aligns them with the ground
    truth before it compares:

    - ``map``: the origin is that of the ground truth. No alignment.
    - ``odom``, ``odom_1``, ``odom_2``, …: the origin is the body at the first image. The first pose
      is laid on the true one (a rigid transform).
    - If `scale_free` is announced, the unit is unknown as well: Sim(3), the rotation, translation
      and scale of least squares.

    It is ``map`` if the announced pose of the vehicle was true for the image at which the tracker's
    poses start:

    - the node was there when the run began: it is not a restarted one;
    - the vehicle had not been armed (and had not taken off) at that image's stamp;
    - the vehicle takes commands (its announced control rate is above 0), so that it stands still
      until it sends `Armed`; or, for a recorded vehicle, which may move from the start without any
      event, the image is not later than a camera's period and latency after the announcement;
    - the estimates are in metres: the estimator is not scale-free.

    Otherwise it is ``odom``, whose origin is the body at that image, and after a restart
    ``odom_1``, ``odom_2``, … A restarted node sends `TrackingLost`, then `TrackingRegained`.
    """

    needs: frozenset[str] = frozenset()
    """Kinds of image that the camera must give, all of them; ``rgb`` serves for ``grey``, too."""
    pinhole_only: bool = False
    """Whether the images must be without distortion; see `refusal` for other conditions."""
    method: str = ""
    """Name of the method, for the report."""
    scale_free: bool = False
    """Whether the unit of length is the tracker's own, as that of a single camera is."""

    estimates = Output(PoseEstimate)
    tracking_events = Output(TrackingEvent)
    features = Output(TrackedFeatures)

    camera: CameraAnnouncement | None = None
    _vehicles: tuple[VehicleAnnouncement, ...] = ()
    _cameras: tuple[str, ...] = ()
    _refusals: tuple[str, ...] = ()
    _mount: Mount | None = None
    _lost = False
    _armed_at: Mapping[str, int] = MappingProxyType({})

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates."""
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
        if refusal := self.refusal(announcement):
            self._refusals += (f"{announcement.source}: {refusal}",)
            return
        self.camera = announcement
        self.narrow("frames", announcement.source)

    def refusal(self, camera: CameraAnnouncement) -> str:
        """Return why a camera's images are of no use here, in a sentence; empty if they are."""
        if not self.pinhole_only or camera.info.is_pinhole:
            return ""
        coefficients = ", ".join(f"{value:g}" for value in camera.info.distortion)
        return (
            "expected images without distortion (a camera sends them as well with "
            f"undistorted = true), found {camera.info.distortion_model} with {coefficients}"
        )

    @on(Armed, TakenOff)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Note from when on a vehicle may have left the pose that it announced."""
        self._armed_at = {event.source: event.stamp, **self._armed_at}

    def check(self) -> Iterable[str]:
        """Return the error if no camera gives what is needed."""
        if self.camera is None:
            yield self._no_camera()

    @abstractmethod
    async def run(self) -> None:
        """Track the images."""

    def the_camera(self) -> CameraAnnouncement:
        """Return the announcement of the camera whose images are read.

        Raises:
            FatalError: No camera gives what is needed.
        """
        if self.camera is None:
            self.log.fatal("%s", self._no_camera())
        return self.camera

    def exposed_at(self, image: Image | DepthImage) -> int:
        """Return when an image was exposed on the clock of IMU and ground truth (ns).

        That is its stamp without the offset of the camera's clock, which was announced.
        """
        return image.stamp - round(self.the_camera().time_offset * 1e9)

    def _no_camera(self) -> str:
        if self._refusals:
            return "; ".join(self._refusals)
        named = self.sources.get("frames")
        called = f" called {named}" if named else ""
        found = ", ".join(self._cameras) or "none"
        return (
            f"expected a camera with {', '.join(sorted(self.needs))} images{called}, "
            f"found {found}{suggest(named or '', self._cameras)}"
        )

    def publish(
        self, image: Image | DepthImage, result: TrackingResult, origin: int | None = None
    ) -> None:
        """Send what a tracker found in an image: features, pose, and whether tracking was lost.

        Args:
            image: The image.
            result: What the tracker found in it.
            origin: When the image was exposed at which the tracker's poses start (ns); if `None`,
                the first image that is published with a pose.
        """
        stamp = self.exposed_at(image)
        if self.restarts and self._mount is None and not self._lost:
            self._lost = True
            reason = f"restarted: poses are in {self._odom()} from here on"
            self.tracking_events.send(TrackingLost(stamp=stamp, source=self.name, reason=reason))
        self.features.send(
            TrackedFeatures(
                stamp=image.stamp,
                source=self.name,
                frame_id=image.frame_id,
                points=result.points,
                inliers=result.inliers,
            )
        )
        if result.lost and not self._lost:
            self.log.warning("lost: %s", result.reason or "no reason given")
            self.tracking_events.send(
                TrackingLost(stamp=stamp, source=self.name, reason=result.reason)
            )
        elif self._lost and not result.lost:
            self.log.info("regained %s", result.reason)
            self.tracking_events.send(TrackingRegained(stamp=stamp, source=self.name))
        self._lost = result.lost
        if not result.lost:
            if self._mount is None:
                self._mount = self._mounting(stamp if origin is None else origin)
            self.estimates.send(self._mount.estimate(stamp, self.name, result.pose))

    def _mounting(self, origin: int) -> Mount:
        """Return the mount for a tracker whose poses start at an image of this stamp."""
        camera = self.the_camera()
        vehicles = (v for v in self._vehicles if camera.source.startswith(f"{v.source}/"))
        vehicle = next(vehicles, None) if self.config.origin == "announced" else None
        if (
            vehicle is not None
            and not self.scale_free
            and not self._at_announced_pose(vehicle, origin)
        ):
            self.log.warning(
                "the announced pose of %s is not known to hold at %.3f s, where tracking starts: "
                "estimates are in %s",
                vehicle.source,
                origin / 1e9,
                self._odom(),
            )
            vehicle = None
        return Mount.of(camera, None if self.scale_free else vehicle, self._odom())

    def _at_announced_pose(self, vehicle: VehicleAnnouncement, stamp: int) -> bool:
        """Return whether a vehicle is known to have been at its announced pose at a time (ns)."""
        camera = self.the_camera()
        if self.restarts or self._armed_at.get(vehicle.source, stamp) < stamp:
            return False
        first = camera.latency + (1.0 / camera.rate if camera.rate > 0 else 0.0)
        return vehicle.control_rate > 0 or stamp - vehicle.stamp <= first * 1e9

    def _odom(self) -> str:
        """Return the frame of estimates whose origin is unknown."""
        return f"odom_{self.restarts}" if self.restarts else "odom"


class TrackingResult(msgspec.Struct, frozen=True, eq=False):
    """What a tracker finds in one image: the pose of the camera, and the features it is from.

    Attributes:
        pose: The optical camera at this image in the optical camera at the first one: the transform
            from this frame to that one, shape (4, 4). Metres, or the tracker's own unit.
        lost: Whether the pose is not known; `pose` is then the last known one.
        reason: Why tracking was lost, or how it was regained.
        points: Features that were tracked: column and row, float32 pixels, shape (n, 2).
        inliers: Which of them agree with the pose: bool, shape (n,).
    """

    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
