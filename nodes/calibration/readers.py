"""Readers of other programs' calibration files, independent of `formats`, on OpenCV's functions."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events.geometry import inverse

Floats = npt.NDArray[np.float64]


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
        back = inverse(self.in_imu)
        xyz = (points @ back[:3, :3].T + back[:3, 3]).reshape(-1, 1, 3)
        still = np.zeros(3)
        project: Any = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        return np.asarray(project(xyz, still, still, self.matrix, self.lens)[0]).reshape(-1, 2)


def read(form: str, folder: Path) -> list[ReadCamera]:
    """Read a calibration's cameras from a folder; a `ValueError` says what is unlike the format."""
    return READERS[form](folder)


def _kalibr(folder: Path, name: str = "camchain-imucam.yaml") -> list[ReadCamera]:
    text = (folder / name).read_text(encoding="utf-8")
    if not text.startswith("%YAML"):  # Kalibr reads plain YAML; OpenCV wants to be told
        text = f"%YAML:1.0\n---\n{text}"
    found: list[ReadCamera] = []
    storage = _storage(text)
    while not (node := storage.getNode(f"cam{len(found)}")).empty():
        into = node.getNode("T_cam_imu")
        matrix = np.array([_numbers(into.at(row)) for row in range(into.size())])
        if into.empty():  # OpenVINS's own name
            back = node.getNode("T_imu_cam")
            matrix = inverse(np.array([_numbers(back.at(row)) for row in range(back.size())]))
        model, camera = (node.getNode(f"{x}_model").string() for x in ("distortion", "camera"))
        if camera != "pinhole" or model not in {"radtan", "equidistant"}:
            raise ValueError(f"{name}: expected pinhole with radtan or equidistant, found {model}")
        k = _numbers(node.getNode("distortion_coeffs"))
        shift = node.getNode("timeshift_cam_imu").real()
        middle = _numbers(node.getNode("intrinsics"))
        found.append(
            ReadCamera(inverse(matrix), _k(*middle), np.array(k), model == "equidistant", shift)
        )
    return found


def _vins(folder: Path) -> list[ReadCamera]:
    found: list[ReadCamera] = []
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
        middle = [projection.getNode(key).real() for key in keys[0]]
        k = np.array([lens.getNode(key).real() for key in keys[1]])
        pose = storage.getNode(f"body_T_cam{number}").mat()
        shift = storage.getNode("td").real()
        found.append(ReadCamera(np.asarray(pose, np.float64), _k(*middle), k, fisheye, shift))
    return found


def _basalt(folder: Path) -> list[ReadCamera]:
    value = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))["value0"]
    found = []
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
        found.append(ReadCamera(in_imu, matrix, k, kind == "kb4", shift))
    return found


def _orbslam3(folder: Path) -> list[ReadCamera]:
    text = (folder / "orbslam3.yaml").read_text(encoding="utf-8")
    # ORB-SLAM3 keeps matrices in single precision; what is judged is what the file says.
    storage = _storage(text.replace("dt: f", "dt: d"))
    fisheye = storage.getNode("Camera.type").string() == "KannalaBrandt8"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    pose = storage.getNode("IMU.T_b_c1").mat()
    in_imu = np.eye(4) if pose is None else np.asarray(pose, np.float64)
    found: list[ReadCamera] = []
    while not storage.getNode(f"Camera{len(found) + 1}.fx").empty():
        if found:
            in_imu = in_imu @ np.asarray(storage.getNode("Stereo.T_c1_c2").mat(), np.float64)
        head = f"Camera{len(found) + 1}"
        middle = [storage.getNode(f"{head}.{name}").real() for name in ("fx", "fy", "cx", "cy")]
        k = np.array([storage.getNode(f"{head}.{name}").real() for name in names])
        found.append(ReadCamera(in_imu, _k(*middle), k, fisheye))
    return found


def _vslamlab(folder: Path) -> list[ReadCamera]:
    text = (folder / "calibration.yaml").read_text(encoding="utf-8")
    storage = _storage(text.replace("%YAML 1.2", "%YAML:1.0", 1))  # its nodes need it alive
    cameras, found = storage.getNode("cameras"), []
    for number in range(cameras.size()):
        camera = cameras.at(number)
        (fx, fy), (cx, cy) = (
            _numbers(camera.getNode(name)) for name in ("focal_length", "principal_point")
        )
        pose = np.array(_numbers(camera.getNode("T_BS"))).reshape(4, 4)
        k = np.array(_numbers(camera.getNode("distortion_coefficients")))
        fisheye = camera.getNode("distortion_type").string() == "equid4"
        found.append(ReadCamera(pose, _k(fx, fy, cx, cy), k, fisheye))
    return found


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
