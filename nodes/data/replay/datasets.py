"""Data sets in folders, as published: EuRoC MAV, TUM VI, TUM RGB-D, KITTI odometry.

EuRoC's and TUM RGB-D also as `nodes.data.dataset` writes them. Their worlds, z up, are turned to
NED by half a turn about x. Times count from the first stamp, or from the epoch that ``body.yaml``
or ``camera.yaml`` notes (``epoch_ns``).
"""

from __future__ import annotations

import bisect
import inspect
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from events import (
    CameraAnnouncement,
    CameraInfo,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Quaternion,
    Vector3,
)
from events.frames import (
    OPTICAL_TO_FRD,
    flip_yz,
    inverse,
    multiply,
    rotate_inverse,
    rotation_to_ned,
)
from events.geometry import Pose, pose_matrix, pose_tuples
from nodes.data.dataset.recording import extra_fields
from nodes.data.replay.chains import as_pairs, chain_of, check_size, mountings, with_noise
from nodes.data.replay.folders import (
    Dataset,
    Files,
    Rows,
    Sensor,
    as_pair,
    camera_at,
    read_sensor,
)
from nodes.data.replay.reader import Pinhole, ReplayConfig, ReplayError
from nodes.data.replay.truth import read_truth
from nodes.kalibr import Chain, KalibrCamera, read_chain
from nodes.trajectory_files import Row, read_kitti, read_rows
from runtime.errors import CommandError
from runtime.extras import READERS, others

_MODELS = {"radial-tangential": "plumb_bob", "equidistant": "equidistant"}
"""Kalibr's names of distortion models, and ours."""


class Euroc(Dataset):
    """Reader of a data set's cameras, first IMU and ground truth; the folder has cam0 in it (mav0).

    M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. The body keeps the data
    set's axes: in EuRoC's own those of the IMU, not FRD. Of cameras whose numbers follow each other
    and that stand side by side the second is announced as the right one of a stereo rig.

    D. Schubert et al., "The TUM VI benchmark for evaluating visual-inertial odometry", IROS 2018,
    has the same layout with images of 16 bits, truth in ``mocap0``, and Kalibr's calibration beside
    it in place of a sensor.yaml; the settings can name another.
    """

    layout = "EuRoC's (mav0)"
    noted = "body.yaml"
    calibrated = True

    @classmethod
    def find(cls, path: Path) -> Path | None:
        """Return the folder of cameras and IMU."""
        folders = (path, path / "mav0")
        matches = (f for f in folders if (f / "cam0").is_dir() or (f / "imu0").is_dir())
        return next(matches, None)

    def load(self) -> None:
        """Read cameras, IMU and truth, with their calibrations."""
        folder = self.folder
        chain = self._chain()
        self._imu_source, self._imu_frame = f"{self.vehicle}/imu0", "base_link"
        self._imu = self._measurements(folder / "imu0" / "data.csv")
        imu = self._imu_announcement(chain) if self._imu else None
        mounted: dict[str, tuple[KalibrCamera, Pose]] = {}
        if chain is not None:
            in_body = pose_matrix(imu.position, imu.orientation) if imu else np.eye(4)
            places = mountings(chain, in_body)
            mounted = {
                camera.name: (camera, place)
                for camera, place in zip(chain.cameras, places, strict=True)
            }
        folders = sorted(folder.glob("cam[0-9]*"))
        if self.config.calibration and mounted and not any(f.name in mounted for f in folders):
            raise ReplayError(
                f"calibration: expected one of {', '.join(f.name for f in folders) or 'a camera'}, "
                f"found {', '.join(mounted)}"
            )
        self.sensors += as_pairs([self._camera(folder, mounted) for folder in folders])
        if imu is not None:
            self.sensors.append(imu)
        self.truth = self._poses()
        self.others.append(Rows(Imu, self._imu_source, self._imu, self._measurement))

    def _chain(self) -> Chain | None:
        """Return the calibration that the settings name, or one beside cameras without their own.

        TUM VI has its in ``dso``.
        """
        chain = chain_of(self.config)
        sensors = [*self.folder.glob("cam[0-9]*"), *self.folder.glob("imu0")]
        if chain or all((sensor / "sensor.yaml").is_file() for sensor in sensors):
            return chain
        paths = []
        for names in _CHAINS, _NOISES:
            places = (self.folder, self.folder.parent, self.folder.parent / "dso")
            candidates = (place / name for place in places for name in names)
            paths += [path for path in candidates if path.is_file()][:1]
        if not paths:
            return None
        self.notes.append(f"calibration: {', '.join(map(str, paths))}")
        return read_chain(paths)

    def _poses(self) -> list[tuple[int, list[float]]]:
        for name in _TRUTHS:
            truth = self.folder / name / "data.csv"
            if truth.is_file():
                self.notes.append(f"true poses: {truth}")
                return read_truth(
                    truth, self.complain, euroc=True, whole=self._is_last_line_whole(truth)
                )
        return []

    def _measurement(self, stamp: int, values: list[float]) -> Imu:
        return Imu(
            stamp=stamp,
            source=self._imu_source,
            frame_id=self._imu_frame,
            angular_velocity=(values[0], values[1], values[2]),
            linear_acceleration=(values[3], values[4], values[5]),
        )

    def odometry(self, stamp: int, values: list[float]) -> Odometry:
        """Return the true odometry; the data set has no angular velocity, so 0."""
        x, y, z, qw, qx, qy, qz, u, v, w = [*values, 0.0, 0.0, 0.0][:10]
        turn = qw, qx, qy, qz
        velocity = rotate_inverse(turn, (u, v, w))
        return self.pose(stamp, flip_yz((x, y, z)), rotation_to_ned(turn), velocity)

    def _camera(
        self, folder: Path, mounted: Mapping[str, tuple[KalibrCamera, Pose]]
    ) -> CameraAnnouncement:
        source = f"{self.vehicle}/{folder.name}"
        self.images[source] = files = self._index(folder)
        images = [self.first_image(files[0][1])[0] if files else "grey"]
        if files:
            self._check_bits(files[0][1])
        if (mounting := mounted.get(folder.name)) is not None:
            calibrated, place = mounting
            if files:
                check_size(calibrated, self.first_image(files[0][1])[1:], str(files[0][1]))
            announced = camera_at(source, (*images,), calibrated.info, _rate_of(files), *place)
            return msgspec.structs.replace(announced, time_offset=calibrated.time_offset)
        if not (folder / "sensor.yaml").is_file():
            raise ReplayError(
                f"{folder}: expected a sensor.yaml in it, Kalibr's {_CHAINS[0]} beside the data "
                "set or the setting calibration, found none"
            )
        sensor = read_sensor(folder / "sensor.yaml")
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
        depth = self.folder / folder.name.replace("cam", "depth")
        if depth.is_dir():
            factor = read_sensor(depth / "sensor.yaml").number("depth_factor")
            self.depths[source] = self._index(depth), factor
            images.append("depth")
        info = sensor.converted(
            {"width": int(width), "height": int(height), "fx": fx, "fy": fy, "cx": cx, "cy": cy}
            | {"distortion_model": model, "distortion": lens},
            CameraInfo,
        )
        rate = sensor.number("rate_hz")
        camera = camera_at(source, tuple(images), info, rate, position, orientation)
        return _with_noted(camera, sensor)

    def _imu_announcement(self, chain: Chain | None) -> ImuAnnouncement:
        path = self.folder / "imu0" / "sensor.yaml"
        if not path.is_file():
            if chain is None or chain.imu is None:
                self.complain(
                    f"{path.parent}: expected the IMU's noise in a sensor.yaml or in Kalibr's "
                    f"{_NOISES[0]}, found neither: it is announced without noise"
                )
            announced = ImuAnnouncement(
                stamp=0,
                source=self._imu_source,
                rate=_rate_of(self._imu),
                frame_id=self._imu_frame,
                gyroscope_noise_density=0.0,
                gyroscope_random_walk=0.0,
                accelerometer_noise_density=0.0,
                accelerometer_random_walk=0.0,
            )
            return announced if chain is None else with_noise(announced, chain)
        sensor = read_sensor(path)
        pose = sensor.list("data", 16) if "data" in sensor.lists else np.eye(4)
        position, orientation = pose_tuples(np.reshape(pose, (4, 4)))
        if (position, orientation) != ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)):
            self._imu_frame = self._imu_source
        announced = ImuAnnouncement(
            stamp=0,
            source=self._imu_source,
            rate=sensor.number("rate_hz"),
            frame_id=self._imu_frame,
            position=position,
            orientation=orientation,
            gyroscope_noise_density=sensor.number("gyroscope_noise_density", 0.0),
            gyroscope_random_walk=sensor.number("gyroscope_random_walk", 0.0),
            accelerometer_noise_density=sensor.number("accelerometer_noise_density", 0.0),
            accelerometer_random_walk=sensor.number("accelerometer_random_walk", 0.0),
        )
        announced = _with_noted(announced, sensor)
        return announced if chain is None else with_noise(announced, chain)

    def _index(self, folder: Path) -> Files:
        path = folder / "data.csv"
        rows = read_rows(
            path, ",", (2,), "timestamp, filename", whole=self._is_last_line_whole(path)
        )
        files = sorted((row.nanoseconds(), folder / "data" / row.fields[1]) for row in rows)
        return self._existing(files)

    def _measurements(self, path: Path) -> list[tuple[int, list[float]]]:
        if not path.is_file():
            return []
        rows = read_rows(
            path, ",", (7,), "timestamp, w x 3, a x 3", whole=self._is_last_line_whole(path)
        )
        return sorted((row.nanoseconds(), row.numbers(1, 7)) for row in rows)


_CHAINS = ("camchain-imucam.yaml", "camchain.yaml", "kalibr_imucam_chain.yaml")
_NOISES = ("imu.yaml", "imu_config.yaml", "kalibr_imu_chain.yaml")
_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "gt", "leica0")
"""Folders of true poses, the first that is there counts: EuRoC's, TUM VI's, Basalt's, positions."""


def _rate_of(rows: Sequence[tuple[int, Any]]) -> float:
    """Return the rate of rows with their stamps (ns): 1 over the median interval; 1 of one row."""
    steps = np.diff([row[0] for row in rows])
    return float(1e9 / max(np.median(steps), 1.0)) if len(steps) else 1.0


A = TypeVar("A", CameraAnnouncement, ImuAnnouncement)


def _with_noted(announcement: A, sensor: Sensor) -> A:
    """Return an announcement with what our own data sets note beside the layout's words."""
    fields: dict[str, Any] = {}
    for field in extra_fields(announcement):
        name = field.name
        if name in sensor.lists:
            fields[name] = tuple(sensor.lists[name])
        elif isinstance(field.default, bool):
            fields[name] = sensor.texts.get(name) == "true"
        elif name in sensor.texts:
            fields[name] = sensor.number(name)
    return msgspec.structs.replace(announcement, **fields)


FARTHEST = 20_000_000  # nanoseconds between a depth image and its colour image


class TumRgbd(Dataset):
    """Reader of colour, depth and true poses; the camera looks ahead from the body's origin.

    J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, and
    cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. A depth image gets the stamp of the
    nearest colour image, within 20 ms as in their associate.py.
    """

    layout = "TUM's (rgb.txt)"
    noted = "camera.yaml"

    @classmethod
    def find(cls, path: Path) -> Path | None:
        """Return the folder of rgb.txt."""
        return path if (path / "rgb.txt").is_file() else None

    def load(self) -> None:
        """Read the camera with its images, depth images and truth."""
        folder, camera = self.folder, self.config.camera
        self._source = f"{self.vehicle}/camera"
        self.images[self._source] = rgb = self._index("rgb.txt")
        depth = self._index("depth.txt") if (folder / "depth.txt").is_file() else []
        self.truth = self._poses()
        depth = self._with_colour_stamps(depth, [stamp for stamp, _ in rgb])
        factor = self.config.depth_factor
        span = rgb[-1][0] - rgb[0][0]
        rate = (len(rgb) - 1) * 1e9 / span if span else 30.0
        calibration = folder / self.noted
        if calibration.is_file():
            sensor = read_sensor(calibration)
            factor = sensor.number("depth_factor", factor)
            rate = sensor.number("rate_hz", rate)
            if camera is None:
                model = sensor.texts.get("distortion_model", "plumb_bob")
                lens = {"distortion_model": model, "distortion": sensor.lists.get("distortion")}
                middle = {name: sensor.number(name) for name in ("fx", "fy", "cx", "cy")}
                camera = sensor.converted({**middle, **lens}, Pinhole)
        if camera is None:
            raise ReplayError(
                f"{folder}: expected a camera.yaml or the setting camera, found neither: write "
                "camera = { fx = …, fy = …, cx = …, cy = … } (pixels); the benchmark's page has "
                "those of its sequences (freiburg1: 517.3, 516.5, 318.6, 255.3)"
            )
        self.depths[self._source] = depth, factor
        kind, *size = self.first_image(rgb[0][1])
        kinds = (kind, "depth") if depth else (kind,)
        announced = camera_at(self._source, kinds, camera.info(*size), rate)
        if calibration.is_file():
            announced = _with_noted(announced, sensor)
        self.sensors.append(announced)

    def rows(self) -> Iterator[Rows]:
        """Yield the rows, with those of the camera's pose after the body's."""
        truth, *images = super().rows()
        yield truth
        yield Rows(PoseStamped, self._source, self.truth, self._camera_pose)
        yield from images

    def odometry(self, stamp: int, position: Vector3, optical: Quaternion) -> Odometry:
        """Return the odometry of the body, from the pose of the camera."""
        return self.pose(stamp, position, multiply(optical, inverse(OPTICAL_TO_FRD)))

    def _camera_pose(self, stamp: int, position: Vector3, optical: Quaternion) -> PoseStamped:
        return PoseStamped(stamp=stamp, source=self._source, position=position, orientation=optical)

    def _with_colour_stamps(self, depth: Files, stamps: list[int]) -> Files:
        """Return depth images with the stamps of their colour images; without one: left out."""
        pairs: dict[int, tuple[int, Path]] = {}
        for stamp, path in depth:
            at = bisect.bisect_left(stamps, stamp)
            near = min(stamps[max(at - 1, 0) : at + 1], key=lambda s: abs(s - stamp))
            distance = abs(near - stamp)
            if distance <= FARTHEST and (near not in pairs or distance < pairs[near][0]):
                pairs[near] = distance, path
        if left_out := len(depth) - len(pairs):
            self.trouble.append(f"{left_out} depth images have no colour image near them")
        return sorted((stamp, path) for stamp, (_, path) in pairs.items())

    def _index(self, name: str) -> Files:
        path = self.folder / name
        rows = read_rows(
            path, None, (2,), "timestamp filename", whole=self._is_last_line_whole(path)
        )
        return self._existing(sorted((row.seconds(), self.folder / row.fields[1]) for row in rows))

    def _poses(self) -> list[tuple[int, Vector3, Quaternion]]:
        path = self.folder / "groundtruth.txt"
        if not path.is_file():
            return []
        rows = read_truth(path, self.complain, euroc=False, whole=self._is_last_line_whole(path))
        return [
            (stamp, flip_yz((x, y, z)), rotation_to_ned((w, i, j, k)))
            for stamp, (x, y, z, w, i, j, k) in rows
        ]


_AXES = pose_matrix((0.0, 0.0, 0.0), OPTICAL_TO_FRD)


class Kitti(Dataset):
    """Reader of rectified cameras in a row on a car, and of its true poses if they are there.

    A. Geiger, P. Lenz and R. Urtasun, "Are we ready for autonomous driving? The KITTI vision
    benchmark suite", CVPR 2012, and cvlibs.net/datasets/kitti/eval_odometry.php::

        sequences/00/image_0/000000.png …    left grey camera; 1: right one; 2, 3: in colour
        sequences/00/calib.txt               P0 to P3: projection of the left grey camera's points
        sequences/00/times.txt               seconds
        poses/00.txt                         true poses of the left grey camera, of the first 11

    The body is the left grey camera with a vehicle's axes (FRD), and begins in the world's origin.
    """

    layout = "KITTI's (times.txt and calib.txt)"

    @classmethod
    def find(cls, path: Path) -> Path | None:
        """Return the folder of times.txt and calib.txt."""
        return path if all((path / f"{n}.txt").is_file() for n in ("times", "calib")) else None

    def load(self) -> None:
        """Read the cameras with their images, and the truth."""
        folder = self.folder
        self._stamps = [
            row.seconds() for row in read_rows(folder / "times.txt", None, (1,), "seconds")
        ]
        self.truth = self._poses()
        rows = read_rows(folder / "calib.txt", None, (13,), "name: 12 numbers")
        projections = {row.fields[0].rstrip(":"): row for row in rows}
        seconds = (self._stamps[-1] - self._stamps[0]) / 1e9
        rate = (len(self._stamps) - 1) / seconds if seconds > 0 else 10.0
        cameras: dict[str, CameraAnnouncement] = {}
        for images in sorted(folder.glob("image_[0-3]")):
            source, number = f"{self.vehicle}/{images.name}", images.name[-1]
            paths = sorted(images.glob("*.png"))
            self._count(images, "images", len(paths))
            self.images[source] = list(zip(self._stamps, paths, strict=True))
            if (row := projections.get(f"P{number}")) is None:
                raise ReplayError(f"{folder / 'calib.txt'}: expected P{number}, found none")
            cameras[number] = _camera(source, row, self.first_image(paths[0]), rate)
            if (left := cameras.get({"1": "0", "3": "2"}.get(number, ""))) is not None:
                cameras[number] = as_pair(left, cameras[number])
        if not cameras:
            raise ReplayError(f"{folder}: expected images in image_0 to image_3, found none")
        self.sensors += cameras.values()

    def _poses(self) -> list[tuple[int, Vector3, Quaternion]]:
        path = self.folder.parent.parent / "poses" / f"{self.folder.name}.txt"
        if not path.is_file():
            self.complain(f"expected true poses in {path}, found none")
            return []
        poses = read_kitti(path)
        self._count(path, "poses", len(poses))
        bodies = _AXES @ poses @ np.linalg.inv(_AXES)
        return [(s, *pose_tuples(body)) for s, body in zip(self._stamps, bodies, strict=True)]

    def _count(self, path: Path, name: str, count: int) -> None:
        if count != len(self._stamps):
            raise ReplayError(
                f"{path}: expected {len(self._stamps)} {name}, as many as times.txt has stamps, "
                f"found {count}"
            )


def _camera(source: str, row: Row, first: tuple[str, int, int], rate: float) -> CameraAnnouncement:
    """Return a camera by its projection K [I | t] of points in the left grey camera."""
    projection = np.reshape(row.numbers(1, 13), (3, 4))
    kind, width, height = first
    (fx, _, cx), (_, fy, cy) = projection[:2, :3].tolist()
    info = CameraInfo(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    moved = np.eye(4)
    moved[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return camera_at(source, (kind,), info, rate, *pose_tuples(_AXES @ moved))


_READERS: tuple[type[Dataset], ...] = (Euroc, TumRgbd, Kitti)


def open_folder(path: Path, config: ReplayConfig, vehicle: str) -> Dataset:
    """Return the reader of a data set's folder; a `ReplayError` if its layout is unknown."""
    if (dataset := open_other(path, config, vehicle)) is not None:
        return dataset
    for reader in _READERS:
        if (folder := reader.find(path)) is not None:
            _check_calibration(reader, path, config)
            return reader(folder, config, vehicle)
    *names, last = (reader.layout for reader in (*_other_readers(), *_READERS))
    raise ReplayError(
        f"{path}: expected a ROS 2 bag (metadata.yaml), or a data set of {', '.join(names)} or "
        f"{last}, found a folder with none of these"
    )


def open_other(path: Path, config: ReplayConfig, vehicle: str) -> Dataset | None:
    """Return the reader of another package for a file or folder; `None` if there is none.

    Raises:
        ReplayError: The package's reader cannot be imported, or fails; the message names the
            package.
    """
    for reader, label in _other_readers().items():
        try:
            if (place := reader.find(path)) is not None:
                _check_calibration(reader, path, config)
                return reader(place, config, vehicle)
        except ReplayError:
            raise
        except Exception as error:
            text = f"{path}: {label} cannot read it: {type(error).__name__}: {error}"
            raise ReplayError(text) from error
    return None


def _check_calibration(reader: type[Dataset], path: Path, config: ReplayConfig) -> None:
    if config.calibration and not reader.calibrated:
        raise ReplayError(
            f"calibration: expected a bag of ROS or a data set in {Euroc.layout} layout "
            f"beside it, found one in {reader.layout} layout: {path}"
        )


@cache
def _other_readers() -> dict[type[Dataset], str]:
    """Import and return other packages' readers, with the name of each and of its package."""
    readers: dict[type[Dataset], str] = {}
    for offer in others(READERS):
        try:
            loaded = offer.load()
        except CommandError as error:
            raise ReplayError(str(error)) from error
        if isinstance(loaded, type):  # rows for `judge` are no classes
            label = f"{offer.name} of the package {offer.package}"
            if not issubclass(loaded, Dataset) or inspect.isabstract(loaded):
                raise ReplayError(
                    f"{label}: expected a class derived from {Dataset.__module__}.Dataset, with "
                    f"find and load in it, found {loaded.__name__}"
                )
            readers[loaded] = label
    return readers
