"""An estimator's sensors and results: choice, joint reading, checks, and mounting."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
    PoseEstimate,
    SensorAnnouncement,
    TrajectoryEstimate,
    VehicleAnnouncement,
)
from events.covariance import cross_matrix, moved_covariance
from events.geometry import pose_matrix, pose_tuples
from runtime.errors import suggest


class SensorChoice:
    """Choice of a camera or stereo rig with an IMU, or of a lidar, from announcements.

    Args:
        named: Ports to the sources named in the file: ``frames`` or ``frames.left`` (the first
            camera), ``frames.right``, ``frames.imu``; beside a lidar ``imu``.
        refusals: Reasons, by source, why images of one or both eyes are unusable; called with
            False, as they are, and with True, as they can be rectified.
    """

    def __init__(
        self,
        needs: Collection[str],  # kinds of image that each camera must give
        eyes: int,  # number of cameras, 1 or 2
        inertial: bool,
        named: Mapping[str, str],
        refusals: Callable[[Sequence[CameraAnnouncement], bool], Mapping[str, str]],
    ) -> None:
        # The chosen ones, the left one first, usable images before those to be rectified; empty
        # while there are none.
        self.cameras: tuple[CameraAnnouncement, ...] = ()
        self.rectified = False  # whether their images have to be
        # On the vehicle of the lidar or first camera; `None` while there is none.
        self.imu: ImuAnnouncement | None = None
        self.lidar: LidarAnnouncement | None = None
        self.named = named
        self._needs, self._eyes, self._inertial = frozenset(needs), eyes, inertial
        self._first = named.get("frames.left", named.get("frames"))
        self._second = named.get("frames.right")
        self.imu_port = "imu" if "lidar" in needs else "frames.imu"
        self._imu = named.get(self.imu_port)
        self._refused = refusals
        self._cameras: list[CameraAnnouncement] = []
        self._imus: list[ImuAnnouncement] = []
        self._refusals: dict[str, str] = {}

    def named_cameras(self) -> tuple[str, ...]:
        """Return the cameras or the lidar named in the file, the left one first."""
        return tuple(filter(None, (self._first, self._second)))

    def announced(self, announcement: Announcement) -> None:
        """Add a camera, an IMU or a lidar; choose if now possible."""
        if isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)
        elif "lidar" in self._needs:
            fits = self._first in (None, announcement.source)
            if isinstance(announcement, LidarAnnouncement) and fits and self.lidar is None:
                self.lidar = announcement
        elif isinstance(announcement, CameraAnnouncement):
            self._cameras.append(announcement)
            if not self.cameras or self.rectified:
                self._choose_cameras()
        if self._inertial and self.imu is None and (beside := self._body_sensor()):
            body = beside.rpartition("/")[0]
            self.imu = next((imu for imu in self._imus if self._fits(imu, body)), None)

    def missing(self) -> str:
        """Return a sentence on the missing sensor; empty if none is missing."""
        if "lidar" in self._needs:
            suffix = f" called {self._first}" if self._first else ""
            sentence = "" if self.lidar else f"expected a lidar{suffix}, found none"
        else:
            sentence = "" if self.cameras else self._no_camera()
        if not sentence and self._inertial and self.imu is None:
            names = ", ".join(imu.source for imu in self._imus) or "none"
            return f"expected an IMU beside {self._body_sensor()}, found {names}"
        return sentence

    def _body_sensor(self) -> str:
        sensor = self.lidar or next(iter(self.cameras), None)
        return sensor.source if sensor else ""

    def _fits(self, imu: ImuAnnouncement, body: str) -> bool:
        return imu.source == self._imu or (
            self._imu is None and imu.source.rpartition("/")[0] == body
        )

    def _choose_cameras(self) -> None:
        """Choose the first usable cameras, those that need no rectification before others."""
        sets = list(self._candidates())
        for rectified in (False, True)[: 1 if self.cameras else 2]:
            for cameras in sets:
                refusals = self._refused(cameras, rectified)
                if not refusals:
                    self.cameras, self.rectified, self.imu = cameras, rectified, None
                    return
                self._refusals |= refusals

    def _candidates(self) -> Iterator[tuple[CameraAnnouncement, ...]]:
        for camera in self._cameras:
            right_eye = camera.stereo and camera.source != self._first
            if right_eye or not self._has_all_images(camera, self._first):
                continue
            if self._eyes == 1:
                yield (camera,)
                continue
            right = next((c for c in self._cameras if self._is_partner(c, camera)), None)
            if right is not None and self._has_all_images(right, right.source):
                yield camera, right

    def _is_partner(self, camera: CameraAnnouncement, left: CameraAnnouncement) -> bool:
        if self._second is not None:
            return camera.source == self._second
        return camera.stereo == left.source

    def _has_all_images(self, camera: CameraAnnouncement, named: str | None) -> bool:
        """Return whether a camera has all images; raise `ValueError` if named and without them."""
        if named is not None and camera.source != named:
            return False
        missing = self._needs - image_kinds(camera)
        if missing and named is not None:
            raise ValueError(
                f"expected a camera with {', '.join(sorted(self._needs))} images, "
                f"found none with {', '.join(sorted(missing))}"
            )
        return not missing

    def _no_camera(self) -> str:
        if self._refusals:
            return "; ".join(f"{source}: {reason}" for source, reason in self._refusals.items())
        sources = [camera.source for camera in self._cameras]
        suffix = f" called {self._first}" if self._first else ""
        sensor = "camera" if self._eyes == 1 else "stereo rig"
        return (
            f"expected a {sensor} with {', '.join(sorted(self._needs))} images{suffix}, "
            f"found {', '.join(sources) or 'none'}{suggest(self._first or '', sources)}"
        )


def image_kinds(camera: CameraAnnouncement) -> set[str]:
    """Return a camera's kinds of image; ``rgb`` serves for ``grey``, too."""
    return {*camera.images} | ({"grey"} if "rgb" in camera.images else set())


class MonocularFrame(NamedTuple):
    """An image."""

    image: Image


class MonocularInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    image: Image
    imu: tuple[Imu, ...]


class RgbdFrame(NamedTuple):
    """A colour (or grey) image and the depth of the same exposure."""

    image: Image
    depth: DepthImage


class RgbdInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    image: Image
    depth: DepthImage
    imu: tuple[Imu, ...]


class StereoFrame(NamedTuple):
    """Images of both cameras of a stereo rig, of the same exposure."""

    left: Image
    right: Image


class StereoInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    left: Image
    right: Image
    imu: tuple[Imu, ...]


def sample_rows(samples: Iterable[Imu]) -> npt.NDArray[np.float64]:
    """Return samples of an IMU: stamp (ns), rad/s and m/s² in a row, shape (n, 7)."""
    rows = [(s.stamp, *s.angular_velocity, *s.linear_acceleration) for s in samples]
    return np.array(rows, np.float64).reshape(-1, 7)


class TrackingResult(msgspec.Struct, frozen=True, eq=False):
    """Result of a tracker for an image: camera pose, and the features used.

    Attributes:
        pose: The optical camera at this image in that at the first one, shape (4, 4); metres, or
            the tracker's own unit.
        lost: Whether `pose` is just the last known one.
        reason: Why tracking was lost, or how it was regained.
        points: Tracked features: column and row, float32 pixels, shape (n, 2).
        inliers: Mask of those that agree with the pose: bool, shape (n,); all, if empty.
        velocity: Of the optical camera, in that at the first image, m/s, shape (3,); `None` if
            unknown.
        covariance: Of the pose's error (x, y, z, roll, pitch, yaw) in the optical camera at the
            first image, m², m rad and rad², shape (6, 6): a shift of the camera and a rotation
            about it, along that frame's axes; `None` if unknown.
        map: Number of the pose's map; a new map of guessed pose or unit counts it up, an earlier
            map found again has its old number. Poses of each map are sent in a frame of their own.
    """

    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    velocity: npt.NDArray[np.float64] | None = None
    covariance: npt.NDArray[np.float64] | None = None
    map: int = 0

    def copy(self) -> TrackingResult:
        """Return a copy that no change of these arrays reaches."""
        fields = ((name, getattr(self, name)) for name in self.__struct_fields__)
        arrays = {name: value.copy() for name, value in fields if isinstance(value, np.ndarray)}
        return msgspec.structs.replace(self, **arrays)


_NOT_RIGID = 1e-2  # by how much a rotation's columns may miss length 1 and right angles


def check_result(result: Any) -> str:
    """Return a complaint on the first non-finite number, or nothing; or raise a `ValueError`."""
    if not isinstance(result, TrackingResult):
        raise ValueError(f"expected a TrackingResult, found {_kind(result)}")
    _check_shape("points", result.points, (len(result.points), 2))
    if len(result.inliers) not in {0, len(result.points)}:
        raise ValueError(
            f"inliers: expected as many as points, {len(result.points)}, or none, "
            f"found {len(result.inliers)}"
        )
    if result.lost:
        return ""
    arrays: dict[str, tuple[Any, tuple[int, ...]]] = {"pose": (result.pose, (4, 4))}
    arrays |= {"velocity": (result.velocity, (3,))} if result.velocity is not None else {}
    arrays |= {"covariance": (result.covariance, (6, 6))} if result.covariance is not None else {}
    for name, (array, shape) in arrays.items():
        _check_shape(name, array, shape)
    for name, (array, _) in arrays.items():
        if not np.isfinite(array).all():
            return f"{name}: expected finite numbers, found {array[~np.isfinite(array)][0]}"
    _check_transform("pose", result.pose)
    return ""


def check_trajectory(stamps: npt.NDArray[np.int64], poses: npt.NDArray[np.float64]) -> None:
    """Raise `ValueError` if these are no poses, shape (n, 4, 4), for stamps (ns), shape (n,)."""
    _check_shape("poses", poses, (len(stamps), 4, 4))
    for pose, stamp in zip(poses, stamps.tolist(), strict=True):
        which = f"pose at {stamp / 1e9:.3f} s"
        if not np.isfinite(pose).all():
            raise ValueError(f"{which}: expected finite numbers, found others")
        _check_transform(which, pose)


def _check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    numbers = isinstance(array, np.ndarray) and array.dtype.kind in "fiu"
    if not numbers or array.shape != shape:
        raise ValueError(
            f"{name}: expected a numpy array of numbers of shape {shape}, found {_kind(array)}"
        )


def _check_transform(name: str, pose: npt.NDArray[Any]) -> None:
    """Raise `ValueError` if a matrix of finite numbers, shape (4, 4), is no rigid transform."""
    turn = pose[:3, :3]
    off = np.abs(turn.T @ turn - np.eye(3)).max()
    if off > _NOT_RIGID or np.linalg.det(turn) < 0:
        lengths = ", ".join(f"{length:.3g}" for length in np.linalg.norm(turn, axis=0))
        raise ValueError(
            f"{name}[:3, :3]: expected a rotation (columns of length 1 at right angles, "
            f"determinant 1), found columns of length {lengths}, determinant "
            f"{np.linalg.det(turn):.3g}"
        )
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > _NOT_RIGID:
        raise ValueError(f"{name}[3]: expected 0, 0, 0, 1, found {pose[3].tolist()}")


def _kind(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"shape {value.shape} of {value.dtype}"
    return "None" if value is None else f"a {type(value).__name__}"


Floats = npt.NDArray[np.float64]


class Mount(msgspec.Struct, frozen=True, eq=False):
    """Pose of a camera on a body, and pose of the body at the first image."""

    frame_id: str  # parent frame of the estimates: ``map``, or ``odom``, ``odom_1``, …
    child_frame_id: str  # frame of the body
    start: Floats  # the body at the first image in the parent frame, shape (4, 4)
    camera: Floats  # the optical frame in the body's frame, shape (4, 4)

    @classmethod
    def of(
        cls,
        camera: CameraAnnouncement | SensorAnnouncement,
        vehicle: VehicleAnnouncement | None,
        frame_id: str = "odom",  # parent frame of the estimates if the pose is unknown
    ) -> Mount:
        """Make the mount of an announced camera, or of another sensor in its place.

        Args:
            vehicle: The vehicle, if the body had the announced pose at the first image; else
                `None`.
        """
        return cls(
            frame_id=frame_id if vehicle is None else "map",
            child_frame_id=camera.parent_frame_id,
            start=np.eye(4)
            if vehicle is None
            else pose_matrix(vehicle.position, vehicle.orientation),
            camera=pose_matrix(camera.position, camera.orientation),
        )

    def estimate(self, stamp: int, source: str, result: TrackingResult) -> PoseEstimate:
        """Return the body's pose as an event; its velocity is the camera's (lever ignored)."""
        body = self._bodies(result.pose)
        position, orientation = pose_tuples(body)
        turn = (self.start @ self.camera)[:3, :3]
        velocity = None if result.velocity is None else tuple((turn @ result.velocity).tolist())
        covariance: tuple[float, ...] = ()
        if result.covariance is not None:
            # A rotation about the camera moves the body, which is not there.
            lever = body[:3, 3] - (body @ self.camera)[:3, 3]
            moved = moved_covariance(result.covariance, turn, -cross_matrix(lever) @ turn)
            covariance = tuple(moved.ravel().tolist())
        return PoseEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            position=position,
            orientation=orientation,
            velocity=velocity,
            covariance=covariance,
        )

    def trajectory(
        self,
        stamp: int,  # of the event (ns)
        source: str,
        stamps: npt.NDArray[np.int64],  # those of the poses (ns), shape (n,)
        poses: Floats,  # the optical camera in its own first frame, shape (n, 4, 4)
    ) -> TrajectoryEstimate:
        """Return the body's poses as an event."""
        bodies = self._bodies(poses)
        turns = Rotation.from_matrix(bodies[:, :3, :3])
        return TrajectoryEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            stamps=np.asarray(stamps, np.int64),
            positions=np.ascontiguousarray(bodies[:, :3, 3]),
            orientations=turns.as_quat(scalar_first=True),
        )

    def _bodies(self, poses: Floats) -> Floats:
        """Return poses of the body, shape (..., 4, 4), from those of the camera."""
        bodies: Floats = self.start @ self.camera @ poses @ np.linalg.inv(self.camera)
        return bodies


def crosses(vectors: Floats) -> Floats:
    """Return the matrices of cross products with vectors, shape (n, 3), from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
