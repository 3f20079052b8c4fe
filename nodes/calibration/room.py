"""Reference of the self-test: the calibration room, and independent readers of calibrations."""

from __future__ import annotations

import functools
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Quaternion,
    TakenOff,
    Vector3,
)
from events.geometry import inverse
from runtime import Node, on

Floats = npt.NDArray[np.float64]


CENTRE = np.array([0.0, 0.0, -1.5])  # about where the vehicle flies, metres in ``map``
LOW, HIGH = np.array([-6.0, -6.0, -5.0]), np.array([6.0, 6.0, 0.0])  # corners, metres in ``map``
NEAREST = 0.45  # depth, metres; only the vehicle itself is nearer to a camera
_COUNT = 130


def spheres(angle: float) -> tuple[Floats, Floats]:
    """Return spheres' centres (``map``, m, (n, 3)) and radii (m), each half `angle` (rad) wide."""
    number = np.arange(_COUNT) + 0.5
    down = 1.0 - 2.0 * number / _COUNT
    around = np.pi * (1.0 + 5.0**0.5) * number
    flat = np.sqrt(1.0 - down**2)
    direction = np.column_stack([flat * np.cos(around), flat * np.sin(around), down])
    # As far as it clears every wall by half its radius.
    slow = np.maximum(np.hstack([direction, -direction]), 0.0) + 1.5 * np.sin(angle)
    distance = (np.hstack([HIGH - CENTRE, CENTRE - LOW]) / slow).min(axis=1)
    return CENTRE + direction * distance[:, None], np.sin(angle) * distance


def mjcf(angle: float) -> str:
    """Return the room as a world file; x is north, y west, z up there."""
    walls = []
    for axis, (low, high) in enumerate(zip(LOW, HIGH, strict=True)):
        for side, face in ((-1.0, low), (1.0, high)):
            place, size = (LOW + HIGH) / 2.0, (HIGH - LOW) / 2.0 + 0.2
            place[axis], size[axis] = face + side * 0.1, 0.1
            walls.append(f'<geom type="box" size="{_text(size)}" pos="{_text(place, -1)}"/>')
    balls = [
        f'<geom type="sphere" size="{radius:.9f}" pos="{_text(centre, -1)}" material="white" '
        'rgba="1 1 1 1" contype="0" conaffinity="0"/>'
        for centre, radius in zip(*spheres(angle), strict=True)
    ]
    return f"""<mujoco model="calibration room">
  <option timestep="0.001"/>
  <visual>
    <quality numslices="96" numstacks="96" offsamples="8"/>
    <headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <default><geom rgba="0 0 0 1"/></default>
  <asset><material name="white" rgba="1 1 1 1" emission="1" specular="0"/></asset>
  <worldbody>
    {"".join(walls)}
    {"".join(balls)}
  </worldbody>
</mujoco>
"""


def hits(angle: float, origins: Floats, rays: Floats) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return distances (m) of the first surfaces, and each sphere's number, or below 0 for a wall.

    Args:
        angle: As of `spheres`.
        origins: Metres in ``map``, within the room, shape (n, 3).
        rays: Unit directions in ``map``, shape (n, 3).
    """
    with np.errstate(divide="ignore"):
        faces = np.where(rays > 0, HIGH - origins, LOW - origins) / rays
    wall = faces.argmin(axis=1)
    best, surfaces = (
        faces.min(axis=1),
        -1 - wall - 3 * (np.take_along_axis(rays, wall[:, None], 1)[:, 0] > 0),
    )
    for number, (centre, radius) in enumerate(zip(*spheres(angle), strict=True)):
        to = centre - origins
        along = (to * rays).sum(axis=1)
        inside = radius**2 - ((to * to).sum(axis=1) - along**2)
        distance = along - np.sqrt(np.maximum(inside, 0.0))
        nearer = (inside > 0.0) & (distance > 0.0) & (distance < best)
        best, surfaces = np.where(nearer, distance, best), np.where(nearer, number, surfaces)
    return best, surfaces


def _text(vector: Floats, sign: int = 1) -> str:
    x, y, z = vector
    return f"{x:.9f} {sign * y:.9f} {sign * z:.9f}"


_SAMPLES = 1500  # pixels stored of each depth image


class _Collector(Node):
    """Collector of sensor data in memory, images in grey; not a node type for files."""

    reads_truth = "judging"

    def __init__(self) -> None:
        self.cameras: dict[str, CameraAnnouncement] = {}
        self.imu_announced: ImuAnnouncement | None = None
        self.odometry: list[Odometry] = []
        self.imu: list[Imu] = []
        self.taken_off = 0
        self.images: dict[str, dict[int, npt.NDArray[np.uint8]]] = defaultdict(dict)
        self.poses: dict[str, dict[int, PoseStamped]] = defaultdict(dict)
        self.depths: dict[str, dict[int, npt.NDArray[np.float64]]] = defaultdict(dict)
        """Rows of column, row and depth (metres), by source and stamp."""
        self.vehicle_pixels: dict[str, dict[int, npt.NDArray[np.bool_]]] = defaultdict(dict)
        """Mask of the pixels that show the vehicle itself, by source and stamp."""

    def on_announcement(self, announcement: Announcement) -> None:
        """Store the announcements of cameras and of the IMU."""
        if isinstance(announcement, CameraAnnouncement):
            self.cameras[announcement.source] = announcement
        elif isinstance(announcement, ImuAnnouncement):
            self.imu_announced = announcement

    @on(Odometry, Imu, TakenOff, PoseStamped)
    def record(self, event: Event) -> None:
        """Store odometry, camera poses, IMU samples, and the time of take-off."""
        if isinstance(event, Odometry):
            self.odometry.append(event)
        elif isinstance(event, Imu):
            self.imu.append(event)
        elif isinstance(event, PoseStamped):
            self.poses[event.source][event.stamp] = event
        else:
            self.taken_off = event.stamp

    @on(Image)
    def record_image(self, event: Image) -> None:
        """Store an image in grey."""
        grey = event.data if event.data.ndim == 2 else cv2.cvtColor(event.data, cv2.COLOR_RGB2GRAY)
        self.images[event.source][event.stamp] = np.asarray(grey, np.uint8)

    @on(DepthImage)
    def record_depth(self, event: DepthImage) -> None:
        """Store the same sample of pixels of each depth image, and the vehicle's own pixels."""
        depth = event.data
        pixels = np.random.default_rng(0).integers(0, depth.size, _SAMPLES)
        rows, columns = np.divmod(pixels, depth.shape[1])
        samples = np.column_stack([columns, rows, depth[rows, columns]])
        self.depths[event.source][event.stamp] = samples.astype(np.float64)
        self.vehicle_pixels[event.source][event.stamp] = depth < NEAREST


Stamps = npt.NDArray[np.int64]


class Motion:
    """The true motion of a body: cubic between two or more rows of odometry, with their twists."""

    def __init__(self, rows: Sequence[Odometry]) -> None:
        self.stamps: Stamps = np.array([row.stamp for row in rows], np.int64)
        self.rotations = Rotation.from_quat([row.orientation for row in rows], scalar_first=True)
        self.positions: Floats = np.array([row.position for row in rows])
        self.velocities = self.rotations.apply([row.linear_velocity for row in rows])
        self.rates: Floats = np.array([row.angular_velocity for row in rows])
        seconds = (self.stamps - self.stamps[0]) / 1e9
        self._place = CubicHermiteSpline(seconds, self.positions, self.velocities)

    def at(self, stamps: Stamps) -> tuple[Floats, Rotation]:
        """Return positions (m, (n, 3)) and rotations to the parent frame at stamps (ns, (n,))."""
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self.stamps) - 1)
        before = after - 1
        length = ((self.stamps[after] - self.stamps[before]) / 1e9)[:, None]
        share = ((stamps - self.stamps[before]) / 1e9)[:, None] / length
        base = self.rotations[before]
        turn = (base.inv() * self.rotations[after]).as_rotvec()
        first, last = self.rates[before] * length, self.rates[after] * length
        last = last + 0.5 * np.cross(turn, last)  # as the rotation vector changes there
        vector = (
            (share**3 - 2 * share**2 + share) * first
            + (3 * share**2 - 2 * share**3) * turn
            + (share**3 - share**2) * last
        )
        seconds = (stamps - self.stamps[0]) / 1e9
        return np.asarray(self._place(seconds)), base * Rotation.from_rotvec(vector)

    def mounted(
        self, stamps: Stamps, position: Vector3, orientation: Quaternion
    ) -> tuple[Floats, Rotation]:
        """Return the same as `at` for a sensor at a pose in the body's frame."""
        place, turn = self.at(stamps)
        return place + turn.apply(position), turn * Rotation.from_quat(
            orientation, scalar_first=True
        )

    def rows_of(self, camera: CameraAnnouncement, stamp: int) -> tuple[Floats, Rotation]:
        """Return a camera's pose at each of its rows, of an image with a stamp."""
        height = camera.info.height
        share = np.arange(height) / max(height - 1, 1) - 0.5
        times = np.asarray(stamp - camera.time_offset * 1e9 + camera.readout * 1e9 * share)
        rounded = np.clip(np.rint(times).astype(np.int64), self.stamps[0], self.stamps[-1])
        return self.mounted(rounded, camera.position, camera.orientation)


class ReadCamera(msgspec.Struct, frozen=True, eq=False):
    """Camera of a calibration file."""

    in_imu: Floats  # pose of its optical frame in the IMU's frame, shape (4, 4)
    matrix: Floats  # K, shape (3, 3)
    lens: Floats  # coefficients in OpenCV's order
    fisheye: bool  # whether they are those of OpenCV's fisheye model
    # Seconds from an image's stamp to the IMU's clock, if the file says.
    time_offset: float | None = None

    def project(self, points: Floats) -> Floats:
        """Return the pixels, shape (n, 2), of points in the IMU's frame, metres, shape (n, 3)."""
        from_imu = inverse(self.in_imu)
        xyz = (points @ from_imu[:3, :3].T + from_imu[:3, 3]).reshape(-1, 1, 3)
        zeros = np.zeros(3)
        project: Any = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        return np.asarray(project(xyz, zeros, zeros, self.matrix, self.lens)[0]).reshape(-1, 2)


def read(form: str, folder: Path) -> list[ReadCamera]:
    """Read a calibration's cameras from a folder; a `ValueError` says what is unlike the format."""
    return READERS[form](folder)


def _kalibr(folder: Path, name: str = "camchain-imucam.yaml") -> list[ReadCamera]:
    text = (folder / name).read_text(encoding="utf-8")
    if not text.startswith("%YAML"):  # Kalibr reads plain YAML; OpenCV needs the header
        text = f"%YAML:1.0\n---\n{text}"
    cameras: list[ReadCamera] = []
    storage = _storage(text)
    while not (node := storage.getNode(f"cam{len(cameras)}")).empty():
        transform = node.getNode("T_cam_imu")
        matrix = np.array([_numbers(transform.at(row)) for row in range(transform.size())])
        if transform.empty():  # OpenVINS's own name
            pose = node.getNode("T_imu_cam")
            matrix = inverse(np.array([_numbers(pose.at(row)) for row in range(pose.size())]))
        model, camera = (node.getNode(f"{x}_model").string() for x in ("distortion", "camera"))
        if camera != "pinhole" or model not in {"radtan", "equidistant"}:
            raise ValueError(f"{name}: expected pinhole with radtan or equidistant, found {model}")
        k = _numbers(node.getNode("distortion_coeffs"))
        shift = node.getNode("timeshift_cam_imu").real()
        intrinsics = _numbers(node.getNode("intrinsics"))
        cameras.append(
            ReadCamera(inverse(matrix), _k(*intrinsics), np.array(k), model == "equidistant", shift)
        )
    return cameras


def _vins(folder: Path) -> list[ReadCamera]:
    cameras: list[ReadCamera] = []
    storage = _storage((folder / "vins.yaml").read_text(encoding="utf-8"))
    for number in range(int(storage.getNode("num_of_cam").real())):
        name = storage.getNode(f"cam{number}_calib").string()
        camera = _storage((folder / name).read_text(encoding="utf-8"))
        fisheye = camera.getNode("model_type").string() == "KANNALA_BRANDT"
        projection = camera.getNode("projection_parameters")
        lens = projection if fisheye else camera.getNode("distortion_parameters")
        keys = (["mu", "mv", "u0", "v0"], ["k2", "k3", "k4", "k5"])
        if not fisheye:
            keys = (["fx", "fy", "cx", "cy"], ["k1", "k2", "p1", "p2"])
        intrinsics = [projection.getNode(key).real() for key in keys[0]]
        k = np.array([lens.getNode(key).real() for key in keys[1]])
        pose = storage.getNode(f"body_T_cam{number}").mat()
        shift = storage.getNode("td").real()
        cameras.append(ReadCamera(np.asarray(pose, np.float64), _k(*intrinsics), k, fisheye, shift))
    return cameras


def _basalt(folder: Path) -> list[ReadCamera]:
    value = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))["value0"]
    cameras = []
    for pose, camera in zip(value["T_imu_cam"], value["intrinsics"], strict=True):
        in_imu = np.eye(4)
        quaternion = [pose[key] for key in ("qx", "qy", "qz", "qw")]
        in_imu[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        in_imu[:3, 3] = [pose[key] for key in ("px", "py", "pz")]
        kind, values = camera["camera_type"], camera["intrinsics"]
        names = {
            "kb4": ("k1", "k2", "k3", "k4"),
            "pinhole": (),
            "pinhole-radtan8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        }[kind]
        k = np.array([values[name] for name in names] or [0.0] * 4)
        matrix = _k(*(values[name] for name in ("fx", "fy", "cx", "cy")))
        shift = value["cam_time_offset_ns"] / 1e9
        cameras.append(ReadCamera(in_imu, matrix, k, kind == "kb4", shift))
    return cameras


def _orbslam3(folder: Path) -> list[ReadCamera]:
    text = (folder / "orbslam3.yaml").read_text(encoding="utf-8")
    # ORB-SLAM3 reads matrices in single precision; the file's own numbers are judged.
    storage = _storage(text.replace("dt: f", "dt: d"))
    fisheye = storage.getNode("Camera.type").string() == "KannalaBrandt8"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    pose = storage.getNode("IMU.T_b_c1").mat()
    in_imu = np.eye(4) if pose is None else np.asarray(pose, np.float64)
    cameras: list[ReadCamera] = []
    while not storage.getNode(f"Camera{len(cameras) + 1}.fx").empty():
        if cameras:
            in_imu = in_imu @ np.asarray(storage.getNode("Stereo.T_c1_c2").mat(), np.float64)
        head = f"Camera{len(cameras) + 1}"
        intrinsics = [storage.getNode(f"{head}.{name}").real() for name in ("fx", "fy", "cx", "cy")]
        k = np.array([storage.getNode(f"{head}.{name}").real() for name in names])
        cameras.append(ReadCamera(in_imu, _k(*intrinsics), k, fisheye))
    return cameras


def _vslamlab(folder: Path) -> list[ReadCamera]:
    text = (folder / "calibration.yaml").read_text(encoding="utf-8")
    storage = _storage(text.replace("%YAML 1.2", "%YAML:1.0", 1))  # its nodes need it alive
    cameras, cameras_read = storage.getNode("cameras"), []
    for number in range(cameras.size()):
        camera = cameras.at(number)
        (fx, fy), (cx, cy) = (
            _numbers(camera.getNode(name)) for name in ("focal_length", "principal_point")
        )
        pose = np.array(_numbers(camera.getNode("T_BS"))).reshape(4, 4)
        k = np.array(_numbers(camera.getNode("distortion_coefficients")))
        fisheye = camera.getNode("distortion_type").string() == "equid4"
        cameras_read.append(ReadCamera(pose, _k(fx, fy, cx, cy), k, fisheye))
    return cameras_read


READERS: dict[str, Callable[[Path], list[ReadCamera]]] = {
    "kalibr": _kalibr,
    "openvins": functools.partial(_kalibr, name="kalibr_imucam_chain.yaml"),
    "vins": _vins,
    "basalt": _basalt,
    "orbslam3": _orbslam3,
    "vslamlab": _vslamlab,
}


def _storage(text: str) -> Any:
    return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)


def _numbers(node: Any) -> list[float]:
    return [node.at(place).real() for place in range(node.size())]


def _k(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
