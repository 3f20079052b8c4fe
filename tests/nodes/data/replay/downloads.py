"""Small folders in the layouts that people download: a wall with boxes, flown past, through lenses.

The scene is that of `tests.nodes.estimators.flight`; images are drawn as the published cameras
would have taken them, with their lenses, at less resolution.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from events import CameraInfo
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_euroc, write_kitti
from tests.nodes.estimators.flight import PERIOD, SCENE, camera_in_first
from tests.nodes.estimators.monocular_odometry.world import Floats, Grey, look_with_depth

IMAGES = 16
FIRST = 1_403_636_579_763_555_584
UP: Floats = np.eye(4)[[2, 0, 1, 3]] * np.array([[1.0], [-1.0], [-1.0], [1.0]])
"""From the first camera's axes to a world with z up."""

LEFT = CameraInfo(
    width=376, height=240, fx=229.3, fy=228.6, cx=183.4, cy=123.9,
    distortion=(-0.2834, 0.07396, 0.000194, 1.76e-05, 0.0),
)  # fmt: skip
RIGHT = msgspec.structs.replace(LEFT, fx=228.8, cx=190.0, cy=127.4)
KINECT = CameraInfo(
    width=320, height=240, fx=258.6, fy=258.2, cx=159.3, cy=127.6,
    distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
)  # fmt: skip
CAR = CameraInfo(width=400, height=120, fx=230.0, fy=230.0, cx=196.0, cy=58.0)

MOUNTS = (
    (LEFT, Rotation.from_euler("xyz", [0.02, -0.01, 1.56]), (-0.02, -0.06, 0.01)),
    (RIGHT, Rotation.from_euler("xyz", [0.03, 0.01, 1.57]), (-0.02, 0.05, 0.01)),
)
"""EuRoC's: lens, and the eye in the IMU's axes."""


def stamps() -> list[int]:
    return [FIRST + n * PERIOD for n in range(IMAGES)]


def way() -> list[Floats]:
    """Return the camera's poses in the first one."""
    return [camera_in_first(n * PERIOD, 0) for n in range(IMAGES)]


def seen(camera: Floats, lens: CameraInfo) -> tuple[Grey, Floats]:
    """Return the image of a lens and its depth."""
    wide = CameraInfo.from_fov(lens.width * 5 // 4, lens.height, np.radians(105))
    image, depth = look_with_depth(camera, wide, SCENE)
    rows, columns = np.mgrid[0 : lens.height, 0 : lens.width]
    rays = lens.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    places = wide.project(rays).astype(np.float32).reshape(lens.height, lens.width, 2)
    nothing: Any = None
    return (
        np.asarray(cv2.remap(image, places, nothing, cv2.INTER_LINEAR), np.uint8),
        np.asarray(cv2.remap(depth, places, nothing, cv2.INTER_NEAREST), np.float64),
    )


def euroc(folder: Path) -> Path:
    """Write a sequence in EuRoC's layout: both eyes and the truth of the IMU's frame."""
    mounts = []
    for number, (lens, turn, place) in enumerate(MOUNTS):
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = turn.as_matrix(), place
        mounts.append(mount)
        camera = folder / "mav0" / f"cam{number}"
        (camera / "data").mkdir(parents=True)
        data = ", ".join(f"{value:.15f}" for value in mount.ravel())
        coefficients = ", ".join(map(str, lens.distortion[:4]))
        (camera / "sensor.yaml").write_text(
            f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"
            f"rate_hz: 20\nresolution: [{lens.width}, {lens.height}]\ncamera_model: pinhole\n"
            f"intrinsics: [{lens.fx}, {lens.fy}, {lens.cx}, {lens.cy}]\n"
            "distortion_model: radial-tangential\n"
            f"distortion_coefficients: [{coefficients}]\n"
        )
        rows = "#timestamp [ns],filename\n"
        for stamp, pose in zip(stamps(), way(), strict=True):
            rows += f"{stamp},{stamp}.png\n"
            there = pose @ np.linalg.inv(mounts[0]) @ mount
            cv2.imwrite(str(camera / "data" / f"{stamp}.png"), seen(there, lens)[0])
        (camera / "data.csv").write_text(rows)
    bodies = np.array([UP @ pose @ np.linalg.inv(mounts[0]) for pose in way()])
    (folder / "mav0" / "state_groundtruth_estimate0").mkdir()
    truth = Trajectory.from_matrices(np.array(stamps()), bodies)
    write_euroc(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", truth)
    return folder


def tum_vi(folder: Path) -> Path:
    """Write the sequence of `euroc` in TUM VI's layout: 16 bits, mocap0, and Kalibr's chain."""
    root = euroc(folder) / "mav0"
    chain = ""
    for number, (lens, turn, place) in enumerate(MOUNTS):
        camera = root / f"cam{number}"
        (camera / "sensor.yaml").unlink()
        for path in (camera / "data").iterdir():
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            cv2.imwrite(str(path), image.astype(np.uint16) << 8)
        from_imu = np.eye(4)
        from_imu[:3, :3] = turn.as_matrix().T
        from_imu[:3, 3] = -from_imu[:3, :3] @ place
        rows = "".join(f"  - {row}\n" for row in from_imu.tolist())
        chain += (
            f"cam{number}:\n  T_cam_imu:\n{rows}  camera_model: pinhole\n"
            f"  distortion_coeffs: {list(lens.distortion[:4])}\n  distortion_model: radtan\n"
            f"  intrinsics: {[lens.fx, lens.fy, lens.cx, lens.cy]}\n"
            f"  resolution: {[lens.width, lens.height]}\n  rostopic: /cam{number}/image_raw\n"
        )
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text(chain)
    truth = (root / "state_groundtruth_estimate0" / "data.csv").read_text().splitlines()
    rows = "\n".join(",".join(row.split(",")[:8]) for row in truth)
    (root / "mocap0").mkdir()
    (root / "mocap0" / "data.csv").write_text(f"{rows}\n")
    shutil.rmtree(root / "state_groundtruth_estimate0")
    return folder


def tum(folder: Path) -> Path:
    """Write a sequence in the layout of TUM's RGB-D benchmark; depth comes 7 ms late."""
    lists = {"rgb": "# timestamp filename\n", "depth": "# timestamp filename\n"}
    for kind in lists:
        (folder / kind).mkdir(parents=True)
    truth = ""
    for stamp, pose in zip(stamps(), way(), strict=True):
        image, depth = seen(pose, KINECT)
        names = {"rgb": f"{stamp / 1e9:.6f}", "depth": f"{stamp / 1e9 + 0.007:.6f}"}
        images: dict[str, Any] = {
            "rgb": np.repeat(image[..., None], 3, axis=2),
            "depth": np.rint(5000 * depth).clip(0, 65535).astype(np.uint16),
        }
        for kind, name in names.items():
            lists[kind] += f"{name} {kind}/{name}.png\n"
            cv2.imwrite(str(folder / kind / f"{name}.png"), images[kind])
        world = UP @ pose
        x, y, z, w = Rotation.from_matrix(world[:3, :3]).as_quat()
        place = " ".join(f"{value:.6f}" for value in world[:3, 3])
        truth += f"{names['rgb']} {place} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n"
    for kind, text in lists.items():
        (folder / f"{kind}.txt").write_text(text)
    (folder / "groundtruth.txt").write_text(truth)
    return folder


def kitti(folder: Path) -> Path:
    """Write a sequence in the layout of KITTI's odometry benchmark; return its folder."""
    sequence = folder / "sequences" / "07"
    baseline = 0.12
    calibration = ""
    for number in range(4):
        left = (0.0, -CAR.fx * baseline, 0.4 * CAR.fx, -0.6 * CAR.fx)[number]
        row = [CAR.fx, 0, CAR.cx, left, 0, CAR.fy, CAR.cy, 0, 0, 0, 1, 0]
        calibration += f"P{number}: {' '.join(f'{value:.12e}' for value in row)}\n"
    for number in range(2):
        (sequence / f"image_{number}").mkdir(parents=True)
        for index, pose in enumerate(way()):
            there = pose.copy()
            there[:3, 3] += pose[:3, 0] * number * baseline
            path = sequence / f"image_{number}" / f"{index:06d}.png"
            cv2.imwrite(str(path), look_with_depth(there, CAR, SCENE)[0])
    (sequence / "calib.txt").write_text(calibration)
    times = "".join(f"{(stamp - FIRST) / 1e9:.6e}\n" for stamp in stamps())
    (sequence / "times.txt").write_text(times)
    (folder / "poses").mkdir()
    poses = Trajectory.from_matrices(np.array(stamps()), np.array(way()))
    write_kitti(folder / "poses" / "07.txt", poses)
    return sequence
