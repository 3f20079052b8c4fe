"""The base of all estimators: choice of the sensor, outputs, and the frame of the estimates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    Armed,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    ImuAnnouncement,
    LidarAnnouncement,
    LidarScan,
    PoseEstimate,
    SensorAnnouncement,
    TakenOff,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
    TrajectoryEstimate,
    VehicleAnnouncement,
    VehicleEvent,
)
from nodes.estimators.latency import ResultQueue
from nodes.estimators.rectification import ALIGNED, Rectification, misalignment
from nodes.estimators.rig import Mount, SensorChoice, TrackingResult, check_result, check_trajectory
from runtime import Bundle, Node, NodeConfig, Output, Worker, on
from runtime.channels.streams import Stream
from runtime.errors import DeclarationError, NodeError, suggest
from runtime.extras import why_missing
from runtime.node import matchers
from runtime.time.clock import SECOND
from runtime.typed import TypeVar
from runtime.units import Latency

WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of an estimator's process: a single core, so that sums always have one order."""


class EstimatorConfig(NodeConfig):
    """Settings of every estimator.

    Attributes:
        origin: ``announced``: estimates are in ``map`` and start at the vehicle's announced pose,
            if known to be true (else as ``start``; see `Estimator`). ``start``: they are in
            ``odom``, with its origin at the body at the first image with a pose.
        rectify: Whether images unusable because of their lens or unaligned rows of a stereo pair
            are turned into those of pinhole cameras, else refused. Cameras that need it come after
            others.
        latency: Time on the run's clock from the arrival of an image to its estimate; see
            `Estimator.publish`.
        not_finite: Meaning of a pose that is not finite (NaN): an ``error`` that ends the run, or
            ``lost``.
    """

    origin: Literal["announced", "start"] = "announced"
    rectify: bool = True
    latency: Latency = Latency(0.015)  # immutable
    not_finite: Literal["error", "lost"] = "error"


_FRAMES = Image | DepthImage | LidarScan
_KINDS = ("rgb", "grey", "depth", "segmentation", "lidar")  # kinds of data an estimator may need
F = TypeVar("F", bound=tuple[Any, ...] | Event)
W = TypeVar("W")
C = TypeVar("C", bound=EstimatorConfig, default=EstimatorConfig)


class Estimator(Node[C], ABC):
    """Base class of nodes estimating poses from images or lidar scans.

    A subclass declares its input as ``frames``, a `Bundle` of one camera's images (of a stereo rig
    ``left`` and ``right``, with an IMU also ``imu``), and its needs in `needs`, `eyes`, `inertial`
    and `lenses`; starts its tracker in `on_ready`, when `the_camera` is known; and in `run` calls
    `publish` with a `TrackingResult` for each image::

        class MyEstimator(Estimator):
            needs = frozenset({"grey", "depth"})
            frames = Bundle(RgbdFrame, keep="latest")

            async def on_ready(self) -> None:
                self.tracker = await self.start_tracker(MyTracker, self.the_camera().info)

            async def run(self) -> None:
                async for image, depth in self.frames:
                    args = image.stamp, image.data, depth.data
                    self.publish(image, await self.tracker.call(MyTracker.track, *args))

    The tracker gives poses of the optical camera (x right, y down, z forward) in the optical camera
    at its first image. A `PoseEstimate` is the pose of the body (FRD) that carries the camera, on
    the clock of the IMU (`exposed_at`).

    **Lidars.** With `needs` of ``lidar`` alone, ``frames`` is an `Input` of scans. The tracker
    gives poses of the lidar (x forward, y right, z down) in the lidar at its first scan, that of a
    scan at its last ray, unless `exposed_at` is overridden; no features are sent.

    **Lenses.** Images that `refusal` rejects, by default those of any lens that distorts, and
    stereo pairs that are not `aligned`, are rectified beside the loop
    (`nodes.estimators.rectification`) before `frames` gives it, unless the setting ``rectify`` is
    false; the log says so. `the_camera` is the pinhole camera then, and features are sent where
    they are in the announced camera's own image. Rows keep the read-out time of a rolling shutter
    only nearly.

    **Latency.** An image arrives when `frames` gives it; its estimate goes out when the setting
    ``latency`` is over, wherever the tracker runs: in a process by `start_tracker`, in a thread by
    `offload`, or in `run` itself. Until then `frames` gives no further image: with
    ``keep="latest"`` images arriving meanwhile are skipped. `publish` sees to that; what is sent by
    `estimates` itself goes out at once.

    **Frame and alignment.** The `frame_id` of the estimates, chosen with the first pose of each
    map, says how `nodes.judging.evaluation` aligns them with the ground truth:

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
      event, the image is not farther than a camera's period and latency from the announcement's
      stamp;
    - the estimates are in metres: the estimator is not scale-free.

    Otherwise it is ``odom``, whose origin is the body at that image. After a restart, and with each
    further map of the tracker (`TrackingResult.map`), it is ``odom_1``, ``odom_2``, …, and
    `TrackingLost`, then `TrackingRegained` are sent. The origin of a further map is as near to the
    one before as the tracker guesses.
    """

    needs: frozenset[str] = frozenset()
    """Kinds of image required of the camera (``rgb`` serves ``grey``); or ``lidar`` alone."""
    eyes: int = 1
    """Number of cameras read together; 2 for a stereo rig, with the left camera's pose."""
    inertial: bool = False
    """Whether an IMU is needed on the camera's vehicle."""
    lenses: frozenset[str] = frozenset()
    """Distortion models that the tracker knows, as ``frozenset({"plumb_bob"})``; images of all
    others are rectified first. See also `refusal`."""
    aligned: bool = True
    """Whether the images of a stereo rig must be those of equal pinhole cameras, row by row."""
    method: str = ""
    """Name of the method, for the report."""
    scale_free: bool = False
    """Whether the unit of length is the tracker's own, as for a single camera."""
    library: tuple[str, str] = "", ""
    """Optional module imported by the worker, and its installation."""

    estimates = Output(PoseEstimate)
    tracking_events = Output(TrackingEvent)
    features = Output(TrackedFeatures)
    trajectories = Output(TrajectoryEstimate)

    cameras: tuple[CameraAnnouncement, ...] = ()
    """The `eyes` cameras read, left first; if rectified, their pinhole replacements."""
    imu_announcement: ImuAnnouncement | None = None
    """IMU read, if `inertial`."""
    _vehicles: tuple[VehicleAnnouncement, ...] = ()
    _rectification: Rectification | None = None
    _mounts: Mapping[int, Mount] = MappingProxyType({})
    _frame = ""
    _lost = False
    _warned_unknown = False
    _armed_at: Mapping[str, int] = MappingProxyType({})

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        needs: Any = cls.needs
        if isinstance(needs, property):
            return
        for need in needs if isinstance(needs, Set) else [needs]:
            if need not in _KINDS or needs is need:
                kinds = ", ".join(_KINDS)
                raise DeclarationError(
                    f"{cls.__name__}.needs: expected a set of {kinds}, found {need!r}"
                    + ("" if needs is need else suggest(str(need), _KINDS))
                )
        cls.needs = frozenset(needs)

    def read(self, frame: type[tuple[Any, ...]]) -> None:
        """Set the type of ``frames`` in ``__init__``, if settings choose the inputs.

        The class declares all fields of all such types.
        """
        bundle = Bundle(frame, keep="latest")
        bundle.name = "frames"
        vars(self)["frames"] = bundle.make(self.name)

    @cached_property
    def _choice(self) -> SensorChoice:
        named = dict(self.sources)
        return SensorChoice(self.needs, self.eyes, self.inertial, named, self._refusals)

    @cached_property
    def _result_queue(self) -> ResultQueue:
        return ResultQueue(self.clock, round(self.config.latency * SECOND), self.start)

    @property
    def camera(self) -> CameraAnnouncement | None:
        """Camera of the estimated pose; `None` before known."""
        return self.cameras[0] if self.cameras else None

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates and their inputs."""
        yield EstimatorAnnouncement(
            stamp=0,
            source=self.name,
            method=self.method,
            scale_free=self.scale_free,
            reads=(*sorted(self.needs), *(["imu"] if self.inertial else [])),
            eyes=self.eyes,
            lenses=tuple(sorted(self.lenses)),
            rectifies=self.config.rectify and "lidar" not in self.needs,
            cameras=self._choice.named_cameras(),
        )

    def on_announcement(self, announcement: Announcement) -> None:
        """Choose the first sensors with the needed data, or those named in the file.

        The file names a camera as ``frames``, a stereo rig as ``frames.left`` and ``frames.right``,
        an IMU as ``frames.imu`` (beside a lidar ``imu``).
        """
        if isinstance(announcement, VehicleAnnouncement):
            self._vehicles += (announcement,)
        choice = self._choice
        before, lidar = choice.cameras, choice.lidar
        choice.announced(announcement)
        if choice.cameras is not before or choice.lidar is not lidar:
            self._hook_frame_streams()
        if choice.cameras is not before:
            self._use_cameras(choice.cameras)
            self.imu_announcement = None
        if self.imu_announcement is None and choice.imu is not None:
            self.imu_announcement = choice.imu
            self._narrow_to(choice.imu_port, choice.imu.source)
        if choice.lidar is not None and lidar is None:
            self._narrow_to("frames", choice.lidar.source)

    def _use_cameras(self, cameras: tuple[CameraAnnouncement, ...]) -> None:
        self.cameras, self._rectification = cameras, None
        if self._choice.rectified:
            self._rectification = Rectification(cameras)
            self.cameras = self._rectification.cameras
        ports = ("frames",) if self.eyes == 1 else ("frames.left", "frames.right")
        for port, camera in zip(ports, cameras, strict=True):
            self._narrow_to(port, camera.source)

    def _frame_streams(self) -> list[Stream[Any]]:
        """Return the streams of images or scans."""
        inputs = self.declared.inputs.items()
        ports = [port for port, declaration in inputs if issubclass(declaration.event, _FRAMES)]
        matched = [matcher.stream for matcher in matchers(self).values()]
        return [*matched, *(getattr(self, port) for port in ports)]

    def _hook_frame_streams(self) -> None:
        """Rectify images and record their arrival when they are read."""
        for stream in self._frame_streams():
            stream.before, stream.prepare = self._result_queue.wait, self._prepare_frame

    async def _prepare_frame(self, frame: F) -> F:
        if self._rectification is not None:
            frame = await self.offload(self._rectification.frame, frame)
        self._result_queue.record_arrival(frame)
        return frame

    def _narrow_to(self, port: str, source: str) -> None:
        if port not in self._choice.named:
            self.sources[port] = source

    def _refusals(self, cameras: Sequence[CameraAnnouncement], rectified: bool) -> dict[str, str]:
        if rectified:
            try:
                cameras = Rectification(cameras).cameras if self.config.rectify else cameras
            except ValueError as error:
                return {cameras[0].source: str(error)}
        reasons = {camera.source: reason for camera in cameras if (reason := self.refusal(camera))}
        if len(cameras) < 2 or reasons or not self.aligned:
            return reasons
        if (error_px := misalignment(*cameras)) > ALIGNED:
            left, right = (camera.source for camera in cameras)
            reasons[right] = (
                f"expected its rows aligned with those of {left}, found {error_px:.2g} px off"
            )
        return reasons

    def refusal(self, camera: CameraAnnouncement) -> str:
        """Return why a camera's images are of no use here, in a sentence; empty if they are."""
        model = camera.info.distortion_model
        if camera.info.is_pinhole or model in self.lenses:
            return ""
        coefficients = ", ".join(f"{value:g}" for value in camera.info.distortion)
        supported = f" or with {', '.join(sorted(self.lenses))}" if self.lenses else ""
        return (
            f"expected images without distortion{supported} (rectify = true makes such of others), "
            f"found {model} with {coefficients}"
        )

    @on(Armed, TakenOff)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Record when each vehicle was first armed: from then on it may move."""
        self._armed_at = {event.source: event.stamp, **self._armed_at}

    def check(self) -> Iterable[str]:
        """Return an error if a needed camera or IMU, or in a mere check the library, is missing."""
        library, install = self.library
        if self.checking and library and (reason := why_missing(library)):
            yield f"{self.method} needs {library} ({reason}): {install}"
        if missing := self._missing():
            yield missing
        if self._rectification is not None:
            if not self._frame_streams():
                yield (
                    "expected images read from a Bundle or an Input, which are rectified, or the "
                    f"model of the lens in lenses, found neither: {self._rectification.eyes[0]}"
                )
            for camera, eye in zip(self.cameras, self._rectification.eyes, strict=True):
                self.log.info("%s is rectified: %s", camera.source, eye)

    @abstractmethod
    async def run(self) -> None:
        """Track the images."""

    async def start_tracker(self, make: Callable[..., W], *args: Any) -> Worker[W]:
        """Start a tracker in a process of its own, with a single core and the latency set."""
        latency = self.config.latency
        return await self.worker(make, *args, latency=latency, env=WORKER_ENVIRONMENT)

    def the_camera(self) -> CameraAnnouncement:
        """Return the camera whose images are read; a `FatalError` if none gives what is needed."""
        if self.camera is None:
            self.log.fatal("%s", self._missing())
        return self.camera

    def the_lidar(self) -> LidarAnnouncement:
        """Return the lidar whose scans are read; a `FatalError` if there is none."""
        if self._choice.lidar is None:
            self.log.fatal("%s", self._missing())
        return self._choice.lidar

    def exposed_at(self, image: Event) -> int:
        """Return when an image was exposed on the clock of IMU and ground truth (ns).

        Its stamp less the announced offset of the camera's clock; of a scan its last ray's time.
        """
        if isinstance(image, LidarScan):
            return image.end
        if not isinstance(image, Image | DepthImage):
            return image.stamp
        return image.stamp - round(self.the_camera().time_offset * 1e9)

    def _sensor(self) -> CameraAnnouncement | SensorAnnouncement:
        return self._choice.lidar or self.the_camera()

    def _missing(self) -> str:
        return self._choice.missing()

    def publish(self, image: Event, result: TrackingResult, origin: int | None = None) -> None:
        """Send a tracker's result for an image, once its latency is over: features, pose, loss.

        It goes out when the setting ``latency`` has passed on the clock since `frames` gave the
        image; at once, if that was before now, as after the call of a worker with this latency.
        Results keep their order. One that is due after the end of the run is not sent.

        Args:
            origin: Exposure of the image at which the tracker's poses start (ns); if `None`, of the
                first image published with a pose.

        Raises:
            NodeError: It is no such result.
        """
        stamp = self.exposed_at(image)
        result = self._checked(stamp, result)
        if not self._result_queue.has_arrival(image) and not self._warned_unknown:
            self._warned_unknown = True
            self.log.warning(
                "publish: expected an image read from frames, found one of %s at %.3f s that was "
                "not: its latency is not kept",
                image.source,
                image.stamp / SECOND,
            )
        if self._result_queue.is_due(image):
            self._send_result(image, stamp, result, origin)
        else:
            send = partial(self._send_result, image, stamp, result.copy(), origin)
            self._result_queue.add(image, send)

    def send_result(self, image: Event, result: TrackingResult, origin: int | None = None) -> None:
        """Send a tracker's result now, whatever the setting ``latency`` says; see `publish`.

        For systems whose answers a `Hold` delays.

        Raises:
            NodeError: It is no such result.
        """
        stamp = self.exposed_at(image)
        self._send_result(image, stamp, self._checked(stamp, result), origin)

    def _send_result(
        self, image: Event, stamp: int, result: TrackingResult, origin: int | None
    ) -> None:
        if self.restarts and not self._mounts:
            self._lose(stamp, f"restarted: poses are in {self._odom()} from here on")
        self._send_features(image, result)
        if result.lost:
            self._lose(stamp, result.reason)
            return
        mount = self._mount(result.map, stamp if origin is None else origin)
        if mount.frame_id != self._frame and self._frame:
            reason = f"another map: poses are in {mount.frame_id} from here on"
            if self._lost:
                self.log.warning("%s", reason)
            self._lose(stamp, reason)
        self._frame = mount.frame_id
        if self._lost:
            self._lost = False
            self.log.info("regained %s", result.reason)
            self.tracking_events.send(TrackingRegained(stamp=stamp, source=self.name))
        self.estimates.send(mount.estimate(stamp, self.name, result))

    def _checked(self, stamp: int, result: TrackingResult) -> TrackingResult:
        which = f"pose at {stamp / 1e9:.3f} s"
        try:
            wrong = check_result(result)
        except ValueError as error:
            raise NodeError(self.name, f"{which}: {error}") from None
        if len(result.points) and not len(result.inliers):
            result = msgspec.structs.replace(result, inliers=np.ones(len(result.points), np.bool_))
        if not wrong:
            return result
        if self.config.not_finite == "error":
            cure = 'not_finite = "lost" counts it as lost'
            raise NodeError(self.name, f"{which}: {wrong} ({cure})")
        return msgspec.structs.replace(result, lost=True, reason=wrong)

    def _lose(self, stamp: int, reason: str) -> None:
        if not self._lost:
            self._lost = True
            self.log.warning("lost: %s", reason or "no reason given")
            self.tracking_events.send(TrackingLost(stamp=stamp, source=self.name, reason=reason))

    def _send_features(self, image: Event, result: TrackingResult) -> None:
        if not isinstance(image, Image | DepthImage):
            return
        points = result.points
        if self._rectification is not None:
            points = self._rectification.eyes[0].original(points).astype(np.float32)
        self.features.send(
            TrackedFeatures(
                stamp=image.stamp,
                source=self.name,
                frame_id=image.frame_id,
                points=points,
                inliers=result.inliers,
            )
        )

    def publish_trajectory(
        self, stamps: npt.NDArray[np.int64], poses: npt.NDArray[np.float64], number: int = 0
    ) -> None:
        """Send the tracker's trajectory after loop closures; none without a pose in its map.

        Args:
            stamps: Exposures of the images (`exposed_at`), ns, strictly rising, shape (n,).
            poses: The optical camera as in `TrackingResult`, shape (n, 4, 4).
        """
        try:
            check_trajectory(stamps, poses)
        except ValueError as error:
            raise NodeError(self.name, f"final trajectory: {error}") from None
        if (mount := self._mounts.get(number)) is not None and len(stamps):
            self.trajectories.send(mount.trajectory(self.clock.now(), self.name, stamps, poses))

    def _mount(self, number: int, origin: int) -> Mount:
        """Return the mount of a map's poses; the first map's poses start at `origin`."""
        if (mount := self._mounts.get(number)) is None:
            first = next(iter(self._mounts.values()), None)
            mount = first and msgspec.structs.replace(first, frame_id=self._odom())
            mount = mount or self._mounting(origin)
            self._mounts = {**self._mounts, number: mount}
            self._frame_numbers().append(self._frame_number())
        return mount

    def _mounting(self, origin: int) -> Mount:
        camera = self._sensor()
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
        camera = self._sensor()
        if self.restarts or self._armed_at.get(vehicle.source, stamp) < stamp:
            return False
        first = camera.latency + (1.0 / camera.rate if camera.rate > 0 else 0.0)
        return vehicle.control_rate > 0 or abs(stamp - vehicle.stamp) <= first * 1e9

    def _odom(self) -> str:
        number = self._frame_number()
        return f"odom_{number}" if number else "odom"

    def _frame_number(self) -> int:
        return max([self.restarts, *(number + 1 for number in self._frame_numbers())])

    def _frame_numbers(self) -> list[int]:
        return self.share(f"frames of {self.name}", list[int])
