"""Common parts of data sets in folders: world with z up, image files, rows to merge."""

from __future__ import annotations

import bisect
import heapq
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    Odometry,
    Quaternion,
    Vector3,
    VehicleAnnouncement,
)
from events.frames import OPTICAL_TO_FRD
from events.geometry import pose_matrix
from nodes.data.replay.reader import Reader, ReplayError, Timed, Wants

R = TypeVar("R", bound=tuple[int, Any] | tuple[int, Any, Any])


def while_seen(truth: list[R], first: int, last: int) -> list[R]:
    """Return the truth's ordered rows (stamp (ns) first) in the sensors' time, and one beside."""
    begin = bisect.bisect_right(truth, first, key=lambda row: row[0]) - 1
    end = bisect.bisect_left(truth, last, key=lambda row: row[0]) + 1
    return truth[max(begin, 0) : end]


def vehicle_at(pose: Odometry) -> VehicleAnnouncement:
    """Return a vehicle's announcement from its first known pose."""
    return VehicleAnnouncement(
        stamp=pose.stamp,
        source=pose.source,
        mass=0.0,
        max_thrust=0.0,
        control_rate=0.0,
        position=pose.position,
        orientation=pose.orientation,
    )


def camera_at(
    source: str,
    images: tuple[str, ...],
    info: CameraInfo,
    rate: float,
    position: Vector3 = (0.0, 0.0, 0.0),
    orientation: Quaternion = OPTICAL_TO_FRD,
) -> CameraAnnouncement:
    """Return the announcement of a camera on the body; by default in its origin, looking ahead."""
    return CameraAnnouncement(
        stamp=0,
        source=source,
        images=images,
        info=info,
        rate=rate,
        latency=0.0,
        frame_id=f"{source}_optical",
        parent_frame_id="base_link",
        position=position,
        orientation=orientation,
    )


def as_pair(left: CameraAnnouncement, right: CameraAnnouncement) -> CameraAnnouncement:
    """Return the right camera as of a stereo rig, or unchanged if the two are no pair.

    A pair has one size and one rate, less than 60 degrees between its directions, and the right one
    at least half of their distance to the left one's right.
    """
    one, other = (pose_matrix(each.position, each.orientation) for each in (left, right))
    apart = other[:3, 3] - one[:3, 3]
    distance = float(np.linalg.norm(apart))
    beside = apart @ one[:3, 0] > 0.5 * distance > 0.0 and one[:3, 2] @ other[:3, 2] > 0.5
    alike = [(each.info.width, each.info.height, each.rate) for each in (left, right)]
    if not beside or alike[0] != alike[1]:
        return right
    return msgspec.structs.replace(right, stereo=left.source, baseline=distance)


class Rows(NamedTuple):
    """Ordered rows of a data set, each with its stamp (ns) first, and the function to events."""

    kind: type[Event]
    source: str
    rows: Sequence[tuple[Any, ...]]
    make: Callable[..., Event]


class FolderReader(Reader):
    """Reader of a data set in a folder, with its stamps as times; sensors are below `vehicle`."""

    def __init__(self, folder: Path, vehicle: str) -> None:
        super().__init__()
        self._folder, self._vehicle = folder, vehicle
        self._origin = 0  # stamp in the data set (ns) of the run's time 0
        self._announcements: list[Announcement] = []

    def announcements(self) -> Sequence[Announcement]:
        """Return the announcements of the vehicle, at its first pose, and its sensors."""
        return self._announcements

    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield all events by stamp; at equal stamps, those of earlier `Rows` first."""

        def made(each: Rows) -> Iterator[Event]:
            for row in each.rows:
                time = row[0] - self._origin
                if start <= time and (end is None or time < end):
                    yield each.make(*row)

        wanted = (made(each) for each in self._rows() if wants(each.kind, each.source))
        merged = heapq.merge(*wanted, key=lambda event: event.stamp)
        return (Timed(event.stamp, event) for event in merged)

    @abstractmethod
    def _rows(self) -> Iterator[Rows]:
        """Yield the rows of the truth and of each sensor."""

    def _pose(
        self,
        stamp: int,
        position: Vector3,
        orientation: Quaternion,
        velocity: Vector3 = (0.0, 0.0, 0.0),
    ) -> Odometry:
        """Return the true odometry; velocities missing in the data set are 0."""
        return Odometry(
            stamp=stamp - self._origin,
            source=self._vehicle,
            position=position,
            orientation=orientation,
            linear_velocity=velocity,
            angular_velocity=(0.0, 0.0, 0.0),
        )

    def _image(self, source: str, stamp: int, path: Path) -> Image:
        return read_image(path, stamp - self._origin, source, f"{source}_optical")

    def _depth_image(self, source: str, factor: float, stamp: int, path: Path) -> DepthImage:
        return read_depth(path, stamp - self._origin, source, f"{source}_optical", factor)


def read_image(path: Path, stamp: int, source: str, frame_id: str) -> Image:
    """Read a colour or grey image; a `ReplayError` if it is none."""
    pixels = _pixels(path)
    if pixels.dtype == np.uint16:
        raise ReplayError(f"{path}: expected an image of 8 bits, found one of 16")
    if pixels.ndim == 3:
        code = cv2.COLOR_BGRA2RGB if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
        pixels = cv2.cvtColor(pixels, code)
    encoding = "rgb8" if pixels.ndim == 3 else "mono8"
    return Image(stamp=stamp, source=source, frame_id=frame_id, encoding=encoding, data=pixels)


def read_depth(path: Path, stamp: int, source: str, frame_id: str, factor: float) -> DepthImage:
    """Read a depth image of 16 bits.

    Args:
        factor: Steps per metre; a step of 0 is none, and becomes ``inf``.

    Raises:
        ReplayError: It is none.
    """
    steps = _pixels(path)
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise ReplayError(
            f"{path}: expected a depth image of 16 bits, found {steps.dtype} {steps.shape}"
        )
    metres = steps.astype(np.float32) / np.float32(factor)
    metres[steps == 0] = np.inf
    return DepthImage(stamp=stamp, source=source, frame_id=frame_id, data=metres)


def _pixels(path: Path) -> npt.NDArray[Any]:
    try:
        code = np.fromfile(path, np.uint8)
        pixels = cv2.imdecode(code, cv2.IMREAD_UNCHANGED) if code.size else None
    except (OSError, ValueError, cv2.error) as error:  # a name may hold a null byte
        raise ReplayError(f"{path}: expected an image, found: {error}") from None
    if pixels is None:
        raise ReplayError(f"{path}: expected an image, found something else")
    return pixels
