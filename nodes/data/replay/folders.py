"""Readers of data sets: what each of them defines, and what all have in common."""

from __future__ import annotations

import bisect
import heapq
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

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
from nodes.data.replay.reader import Reader, ReplayConfig, ReplayError, Timed, Wants
from nodes.ros2.messages.images import high_byte

Files = list[tuple[int, Path]]  # images of a camera, by stamp (ns)
T = TypeVar("T")


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
    left_pose, right_pose = (
        pose_matrix(camera.position, camera.orientation) for camera in (left, right)
    )
    apart = right_pose[:3, 3] - left_pose[:3, 3]
    distance = float(np.linalg.norm(apart))
    beside = (
        apart @ left_pose[:3, 0] > 0.5 * distance > 0.0
        and left_pose[:3, 2] @ right_pose[:3, 2] > 0.5
    )
    formats = [(camera.info.width, camera.info.height, camera.rate) for camera in (left, right)]
    if not beside or formats[0] != formats[1]:
        return right
    return msgspec.structs.replace(right, stereo=left.source, baseline=distance)


class Rows(NamedTuple):
    """Ordered rows of a data set, each with its stamp (ns) first, and the function to events.

    The function gets a stamp of the run (ns) in place of the row's, and the rest of the row.
    """

    kind: type[Event]
    source: str
    rows: Sequence[tuple[Any, ...]]
    make: Callable[..., Event]


class Dataset(Reader):
    """Base of the readers of data sets in a layout of files; its sensors are below `vehicle`.

    A subclass says how to recognize its layout and what is in it::

        class MyDataset(Dataset):
            layout = "My own (poses.txt)"

            @classmethod
            def find(cls, path):
                return path if (path / "poses.txt").is_file() else None

            def load(self):
                source = f"{self.vehicle}/camera"
                self.images[source] = [(0, self.folder / "0.png"), …]   # stamps: ns
                self.sensors.append(camera_at(source, ("rgb",), CameraInfo(…), 10.0))
                self.truth += [(0, (x, y, z), (qw, qx, qy, qz)), …]     # of the body, as Odometry

    What it does not say is as here: images are what OpenCV reads, depth images have 16 bits, and
    the events are images, depth images, the truth and `others`, merged by their stamps. The class
    is an entry point of the group ``visnav.readers``.

    Attributes:
        folder: What `find` returned.
        config: Settings of the replay: of a camera without calibration, of depth images.
        vehicle: Source of the truth; sources of sensors begin with it and a slash.
        images: Files of each camera's images with their stamps (ns), by source.
        depths: The same of depth images, with their steps per metre.
        truth: Rows of the true pose: a stamp (ns), and the arguments of `odometry`, in order.
        others: Rows of sensors besides cameras.
        sensors: Announcements of cameras and other sensors.

    Raises:
        ReplayError: A file is not as published.
    """

    layout: ClassVar[str]  # name and marks of the layout, for an error
    noted: ClassVar[str] = ""  # file in which our own data sets note the epoch
    calibrated: ClassVar[bool] = False  # whether it heeds the setting `calibration`

    def __init__(self, folder: Path, config: ReplayConfig, vehicle: str) -> None:
        super().__init__()
        self.folder, self.config, self.vehicle = folder, config, vehicle
        self.images: dict[str, Files] = {}
        self.depths: dict[str, tuple[Files, float]] = {}
        self.truth: list[Any] = []
        self.others: list[Rows] = []
        self.sensors: list[Announcement] = []
        self._origin = 0  # stamp in the data set (ns) of the run's time 0
        try:
            self._epoch = noted_epoch(folder / self.noted) if self.noted else []
            self.load()
            self._announce_vehicle()
        except ValueError as error:
            raise ReplayError(str(error)) from None

    # The contract: a subclass has the first two, and others where it differs.

    @classmethod
    @abstractmethod
    def find(cls, path: Path) -> Path | None:
        """Return what to read, `path` or a folder in it; `None` if the layout is another."""

    @abstractmethod
    def load(self) -> None:
        """Read indices, calibrations and truth, no images, into the attributes.

        Stamps are as in the data set: the earliest becomes the run's time 0. A `ValueError` names
        the file; `complain` is for parts left out, `notes` for a choice that was made.
        """

    def odometry(self, stamp: int, *pose: Any) -> Odometry:
        """Return the true odometry of a row of the truth, at a stamp of the run (ns).

        By default the row is position and orientation of the body (FRD) in the world (NED), and
        perhaps its velocity in its own frame: see `pose`.
        """
        return self.pose(stamp, *pose)

    def read_image(self, path: Path) -> npt.NDArray[np.uint8]:
        """Read an image, shape (height, width, 3) as RGB or (height, width); beside the loop."""
        return read_image(path)

    def read_depth(self, path: Path, factor: float) -> npt.NDArray[np.float32]:
        """Read a depth image in metres along z, ``inf`` where there is none; beside the loop.

        Args:
            factor: Steps per metre, as `depths` has it.
        """
        return read_depth(path, factor)

    def rows(self) -> Iterator[Rows]:
        """Yield the rows of all events; at equal stamps, earlier ones come first."""
        yield from self.others
        yield Rows(Odometry, self.vehicle, self.truth, self.odometry)
        for source, (files, factor) in self.depths.items():
            yield Rows(DepthImage, source, files, partial(self._depth_image, source, factor))
        for source, files in self.images.items():
            yield Rows(Image, source, files, partial(self._image, source))

    # The methods below rely on the contract.

    def pose(
        self,
        stamp: int,
        position: Vector3,
        orientation: Quaternion,
        velocity: Vector3 = (0.0, 0.0, 0.0),
    ) -> Odometry:
        """Return the true odometry; velocities missing in the data set are 0."""
        return Odometry(
            stamp=stamp,
            source=self.vehicle,
            position=position,
            orientation=orientation,
            linear_velocity=velocity,
            angular_velocity=(0.0, 0.0, 0.0),
        )

    def first_image(self, path: Path) -> tuple[str, int, int]:
        """Return the kind of images, ``rgb`` or ``grey``, their width and their height."""
        pixels = self.read_image(path)
        return "rgb" if pixels.ndim == 3 else "grey", pixels.shape[1], pixels.shape[0]

    def announcements(self) -> Sequence[Announcement]:
        """Return the announcements of the vehicle, at its first pose, and its sensors."""
        return self.sensors

    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield all events by stamp; at equal stamps, those of earlier `Rows` first."""

        def events(table: Rows) -> Iterator[Event]:
            for row in table.rows:
                time = row[0] - self._origin
                if start <= time and (end is None or time < end):
                    yield table.make(time, *row[1:])

        streams = (events(table) for table in self.rows() if wants(table.kind, table.source))
        merged = heapq.merge(*streams, key=lambda event: event.stamp)
        return (Timed(event.stamp, event) for event in merged)

    def _check_bits(self, path: Path) -> None:
        """Complain of an image of 16 bits that will be dark."""
        pixels = _pixels(path)
        if pixels.dtype == np.uint16:
            self.check_bits(str(path), pixels)

    def _is_last_line_whole(self, path: Path) -> bool:
        """Return whether a file's last line counts: a killed run of ours may have cut it off."""
        try:
            with path.open("rb") as file:
                file.seek(-1, 2)
                torn = bool(self._epoch) and file.read() != b"\n"
        except OSError:  # it is empty or unreadable, which its reader reports
            return True
        if torn:
            self.complain(f"{path}: the last line is cut off, and left out")
        return not torn

    def _existing(self, files: Files) -> Files:
        """Return a camera's images without those that a killed run of ours listed, not wrote."""
        existing = [entry for entry in files if not self._epoch or entry[1].is_file()]
        if existing and (missing := len(files) - len(existing)):
            self.complain(
                f"{files[0][1].parent}: {missing} listed images are missing, and left out"
            )
        return existing or files

    def _announce_vehicle(self) -> None:
        """Choose time 0, cut the truth to the sensors' time, and announce the vehicle."""
        others = [row[0] for table in self.others for row in table.rows]
        firsts = [files[0][0] for files in self.images.values() if files]
        lasts = [files[-1][0] for files in self.images.values() if files]
        if not firsts and not others:
            raise ReplayError(f"{self.folder}: expected the data of cameras or an IMU, found none")
        first, last = min([*firsts, *others]), max([*lasts, *others])
        # One pose before and one after the sensors' time remain.
        start = bisect.bisect_right(self.truth, first, key=lambda row: row[0]) - 1
        end = bisect.bisect_left(self.truth, last, key=lambda row: row[0]) + 1
        self.truth = self.truth[max(start, 0) : end]
        self._origin = min([first, *(row[0] for row in self.truth[:1]), *self._epoch])
        if self.truth:
            first_image = min(firsts, default=self.truth[0][0])
            row = next((row for row in self.truth if row[0] >= first_image), self.truth[0])
            self.sensors.insert(0, vehicle_at(self.odometry(row[0] - self._origin, *row[1:])))

    def _image(self, source: str, stamp: int, path: Path) -> Image:
        pixels = self.read_image(path)
        return Image(
            stamp=stamp,
            source=source,
            frame_id=f"{source}_optical",
            encoding="rgb8" if pixels.ndim == 3 else "mono8",
            data=pixels,
        )

    def _depth_image(self, source: str, factor: float, stamp: int, path: Path) -> DepthImage:
        metres, frame_id = self.read_depth(path, factor), f"{source}_optical"
        return DepthImage(stamp=stamp, source=source, frame_id=frame_id, data=metres)


def noted_epoch(path: Path) -> list[int]:
    """Return the noted epoch (ns) of our own data sets, or nothing; may raise `ReplayError`."""
    text = read_sensor(path).texts.get("epoch_ns") if path.is_file() else None
    if text is not None and not (text.isdecimal() and len(text) <= 19):
        raise ReplayError(f"{path}: epoch_ns: expected whole nanoseconds, found {text!r:.80}")
    return [] if text is None else [int(text)]


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Read a colour (RGB) or grey image, of 16 bits the high byte; may raise `ReplayError`."""
    pixels: Any = high_byte(_pixels(path))
    if pixels.ndim == 3:
        code = cv2.COLOR_BGRA2RGB if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
        pixels = cv2.cvtColor(pixels, code)
    return np.asarray(pixels, np.uint8)


def read_depth(path: Path, factor: float) -> npt.NDArray[np.float32]:
    """Read a depth image of 16 bits in metres, at `factor` steps per metre; step 0 becomes ``inf``.

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
    return metres


def _pixels(path: Path) -> npt.NDArray[Any]:
    try:
        code = np.fromfile(path, np.uint8)
        pixels = cv2.imdecode(code, cv2.IMREAD_UNCHANGED) if code.size else None
    except (OSError, ValueError, cv2.error) as error:  # a name may hold a null byte
        raise ReplayError(f"{path}: expected an image, found: {error}") from None
    if pixels is None:
        raise ReplayError(f"{path}: expected an image, found something else")
    return pixels


class Sensor(msgspec.Struct, frozen=True):
    """A sensor.yaml: its lines by key, and all lists of numbers as such."""

    path: Path
    texts: dict[str, str]
    lists: dict[str, list[float]]

    def number(self, key: str, default: float | None = None) -> float:
        """Return a number; a `ReplayError` if there is none."""
        try:
            return float(self.texts[key])
        except (KeyError, ValueError):
            if default is not None and key not in self.texts:
                return default
            text = self.texts.get(key, "nothing")
            raise ReplayError(f"{self.path}: {key}: expected a number, found {text}") from None

    def list(self, key: str, *lengths: int) -> list[float]:
        """Return a list of numbers; a `ReplayError` if there is none of such a length."""
        numbers = self.lists.get(key, [])
        if len(numbers) not in lengths:
            counts = " or ".join(map(str, lengths))
            raise ReplayError(f"{self.path}: {key}: expected {counts} numbers, found {numbers}")
        return numbers

    def converted(self, values: dict[str, Any], kind: type[T]) -> T:
        """Return values as a struct; a `ReplayError` if they do not fit."""
        try:
            return msgspec.convert(values, kind)
        except msgspec.ValidationError as error:
            raise ReplayError(f"{self.path}: {error}") from None


def read_sensor(path: Path) -> Sensor:
    """Read a sensor.yaml of ``key: value`` lines with bracketed lists; may raise `ReplayError`."""
    try:
        text = re.sub(r"#.*", "", path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"{path}: expected a sensor's description, found: {error}") from None
    lists = {}
    for key, content in re.findall(r"(\w+):\s*\[([^\]]*)\]", text):
        try:
            lists[key] = [float(value) for value in content.split(",") if value.strip()]
        except ValueError:
            raise ReplayError(f"{path}: {key}: expected numbers, found {content!r:.80}") from None
    texts = {
        key: value.strip() for key, value in re.findall(r"^\s*(\w+):[ \t]*([^\[\n]+)$", text, re.M)
    }
    return Sensor(path, texts, lists)
