"""Data sets in the layout of EuRoC MAV, as published, and as `nodes.data.dataset` writes them.

M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. The world, z up, is turned to
NED by half a turn about x. Times count from the first stamp, or from the epoch that ``body.yaml``
notes (``epoch_ns``). The body keeps the data set's axes: in EuRoC's own those of the IMU, not FRD.
The second of two cameras side by side is announced as the right one of a stereo rig.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from events import CameraAnnouncement, CameraInfo, DepthImage, Image, Imu, ImuAnnouncement, Odometry
from events.base import UNIT_TOLERANCE
from events.frames import flip_yz, rotate_inverse, rotation_to_ned
from events.geometry import pose_tuples
from nodes.data.replay.folders import (
    FolderReader,
    Rows,
    as_pair,
    camera_at,
    read_image,
    vehicle_at,
    while_seen,
)
from nodes.data.replay.reader import ReplayError
from nodes.trajectory.formats import euroc_rows
from nodes.trajectory.table import read_rows

_TRUTH = "state_groundtruth_estimate0"
_MODELS = {"radial-tangential": "plumb_bob", "equidistant": "equidistant"}
"""Kalibr's names of distortion models, and ours."""
T = TypeVar("T")


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
            if default is not None:
                return default
            found = self.texts.get(key, "nothing")
            raise ReplayError(f"{self.path}: {key}: expected a number, found {found}") from None

    def list(self, key: str, *lengths: int) -> list[float]:
        """Return a list of numbers; a `ReplayError` if there is none of such a length."""
        found = self.lists.get(key, [])
        if len(found) not in lengths:
            counts = " or ".join(map(str, lengths))
            raise ReplayError(f"{self.path}: {key}: expected {counts} numbers, found {found}")
        return found

    def converted(self, values: dict[str, Any], kind: type[T]) -> T:
        """Return values as a struct; a `ReplayError` if they do not fit."""
        try:
            return msgspec.convert(values, kind)
        except msgspec.ValidationError as error:
            raise ReplayError(f"{self.path}: {error}") from None


class Euroc(FolderReader):
    """Reader of a data set's cameras, first IMU and ground truth.

    Args:
        folder: The one with cam0 in it (mav0).
        vehicle: Source of the truth; sensors are below it.

    Raises:
        ReplayError: A file is not as published.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        super().__init__(folder, vehicle)
        self._images: dict[str, list[tuple[int, Path]]] = {}
        self._depths: dict[str, tuple[list[tuple[int, Path]], float]] = {}
        self._imu_frame = "base_link"
        try:
            cameras = [self._camera(camera) for camera in sorted(folder.glob("cam[0-9]*"))]
            if len(cameras) == 2:
                cameras[1] = as_pair(*cameras)
            self._announcements += cameras
            self._imu = self._measurements(folder / "imu0" / "data.csv")
            if self._imu:
                self._announcements.append(self._imu_announcement())
            truth = folder / _TRUTH / "data.csv"
            rows = euroc_rows(truth, tolerance=UNIT_TOLERANCE) if truth.is_file() else ()
            self._truth = sorted((stamp, values) for _, stamp, values in rows)
        except ValueError as error:
            raise ReplayError(str(error)) from None
        stamps = [row[0] for row in self._imu]
        stamps += [stamp for rows in self._images.values() for stamp, _ in rows]
        if not stamps:
            raise ReplayError(f"{folder}: expected the data of cameras or an IMU, found none")
        self._truth = while_seen(self._truth, min(stamps), max(stamps))
        firsts = [min(stamps), *(row[0] for row in self._truth[:1])]
        self._origin = min(firsts + noted_epoch(folder / "body.yaml"))
        if self._truth:
            images = [rows[0][0] for rows in self._images.values() if rows]
            first = min(images, default=self._truth[0][0])
            row = next((row for row in self._truth if row[0] >= first), self._truth[0])
            self._announcements.insert(0, vehicle_at(self._odometry(*row)))

    def _rows(self) -> Iterator[Rows]:
        yield Rows(Imu, f"{self._vehicle}/imu0", self._imu, self._measurement)
        yield Rows(Odometry, self._vehicle, self._truth, self._odometry)
        for source, (rows, factor) in self._depths.items():
            yield Rows(DepthImage, source, rows, partial(self._depth_image, source, factor))
        for source, rows in self._images.items():
            yield Rows(Image, source, rows, partial(self._image, source))

    def _measurement(self, stamp: int, values: list[float]) -> Imu:
        return Imu(
            stamp=stamp - self._origin,
            source=f"{self._vehicle}/imu0",
            frame_id=self._imu_frame,
            angular_velocity=(values[0], values[1], values[2]),
            linear_acceleration=(values[3], values[4], values[5]),
        )

    def _odometry(self, stamp: int, values: list[float]) -> Odometry:
        """Return the true odometry; the data set has no angular velocity, so 0."""
        x, y, z, qw, qx, qy, qz, u, v, w = values[:10]
        turn = qw, qx, qy, qz
        velocity = rotate_inverse(turn, (u, v, w))
        return self._pose(stamp, flip_yz((x, y, z)), rotation_to_ned(turn), velocity)

    def _camera(self, folder: Path) -> CameraAnnouncement:
        sensor = read_sensor(folder / "sensor.yaml")
        source = f"{self._vehicle}/{folder.name}"
        width, height = sensor.list("resolution", 2)
        fx, fy, cx, cy = sensor.list("intrinsics", 4)
        lens = sensor.list("distortion_coefficients", 4, 5)
        named = sensor.texts.get("distortion_model", "")
        model = _MODELS.get(named, "" if any(lens) else "plumb_bob")
        if not model:
            raise ReplayError(
                f"{sensor.path}: distortion_model: expected one of {', '.join(_MODELS)}, "
                f"found {named!r}"
            )
        if model == "plumb_bob":
            lens = [*lens, 0.0][:5]  # of four, k3 is none
        position, orientation = pose_tuples(np.reshape(sensor.list("data", 16), (4, 4)))
        self._images[source] = rows = self._index(folder)
        images = ["grey"]
        if rows and read_image(rows[0][1], 0, source, "").encoding == "rgb8":
            images = ["rgb"]
        depth = self._folder / folder.name.replace("cam", "depth")
        if depth.is_dir():
            factor = read_sensor(depth / "sensor.yaml").number("depth_factor")
            self._depths[source] = self._index(depth), factor
            images.append("depth")
        info = sensor.converted(
            {"width": int(width), "height": int(height), "fx": fx, "fy": fy, "cx": cx, "cy": cy}
            | {"distortion_model": model, "distortion": lens},
            CameraInfo,
        )
        rate = sensor.number("rate_hz")
        return camera_at(source, tuple(images), info, rate, position, orientation)

    def _imu_announcement(self) -> ImuAnnouncement:
        sensor = read_sensor(self._folder / "imu0" / "sensor.yaml")
        given = sensor.list("data", 16) if "data" in sensor.lists else np.eye(4)
        position, orientation = pose_tuples(np.reshape(given, (4, 4)))
        if (position, orientation) != ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)):
            self._imu_frame = f"{self._vehicle}/imu0"
        return ImuAnnouncement(
            stamp=0,
            source=f"{self._vehicle}/imu0",
            rate=sensor.number("rate_hz"),
            frame_id=self._imu_frame,
            position=position,
            orientation=orientation,
            gyroscope_noise_density=sensor.number("gyroscope_noise_density", 0.0),
            gyroscope_random_walk=sensor.number("gyroscope_random_walk", 0.0),
            accelerometer_noise_density=sensor.number("accelerometer_noise_density", 0.0),
            accelerometer_random_walk=sensor.number("accelerometer_random_walk", 0.0),
        )

    def _index(self, folder: Path) -> list[tuple[int, Path]]:
        rows = read_rows(folder / "data.csv", ",", (2,), "timestamp, filename")
        return sorted((row.nanoseconds(), folder / "data" / row.fields[1]) for row in rows)

    def _measurements(self, path: Path) -> list[tuple[int, list[float]]]:
        if not path.is_file():
            return []
        rows = read_rows(path, ",", (7,), "timestamp, w x 3, a x 3")
        return sorted((row.nanoseconds(), row.numbers(1, 7)) for row in rows)


def noted_epoch(path: Path) -> list[int]:
    """Return the noted epoch (ns) of our own data sets, or nothing; may raise `ReplayError`."""
    text = read_sensor(path).texts.get("epoch_ns") if path.is_file() else None
    if text is not None and not (text.isdecimal() and len(text) <= 19):
        raise ReplayError(f"{path}: epoch_ns: expected whole nanoseconds, found {text!r:.80}")
    return [] if text is None else [int(text)]


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
