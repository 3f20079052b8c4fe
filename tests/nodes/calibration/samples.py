"""Rigs, and a flight in the calibration room without a simulator: images are cast ray by ray."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    CameraInfo,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Vector3,
)
from events.camera_info import DistortionModel
from events.frames import OPTICAL_TO_FRD, from_rpy, multiply
from nodes.calibration.room import CENTRE, Floats, Motion, _Collector, hits
from nodes.data.dataset.recording import Rig

IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="base_link",
    gyroscope_noise_density=1.5e-4,
    gyroscope_random_walk=2e-5,
    accelerometer_noise_density=2e-3,
    accelerometer_random_walk=3e-3,
)

LENSES: dict[str, tuple[DistortionModel, tuple[float, ...]]] = {
    "pinhole": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "radtan4": ("plumb_bob", (-0.28, 0.07, 1e-4, 2e-5, 0.0)),
    "radtan5": ("plumb_bob", (-0.28, 0.07, 1e-4, 2e-5, 0.01)),
    "rational": ("rational_polynomial", (-0.28, 0.07, 1e-4, 2e-5, 0.01, 0.01, 0.02, 0.003)),
    "kb4": ("equidistant", (0.01, -0.02, 0.003, 0.001)),
}


def camera(
    name: str = "left",
    lens: str = "pinhole",
    position: Vector3 = (0.15, 0.02, -0.03),
    images: tuple[str, ...] = ("rgb", "depth"),
    **more: Any,
) -> CameraAnnouncement:
    """Return a camera that looks somewhere, with fx ≠ fy and an odd principal point."""
    model, coefficients = LENSES[lens]
    info = CameraInfo(
        width=640,
        height=480,
        fx=401.25,
        fy=399.5,
        cx=322.1,
        cy=237.7,
        distortion_model=model,
        distortion=coefficients,
    )
    fields: dict[str, Any] = {
        "stamp": 0,
        "source": f"drone/{name}",
        "images": images,
        "info": info,
        "rate": 30.0,
        "latency": 0.04,
        "frame_id": f"drone/{name}_optical",
        "parent_frame_id": "base_link",
        "position": position,
        "orientation": multiply(from_rpy(0.1, -0.5, 0.3), OPTICAL_TO_FRD),
    }
    return CameraAnnouncement(**(fields | more))


def stereo(lens: str = "pinhole", **more: Any) -> Rig:
    """Return a pair of cameras, the right one somewhat turned, and an IMU."""
    turned = multiply(from_rpy(0.11, -0.49, 0.31), OPTICAL_TO_FRD)
    right = camera(
        "right",
        lens,
        (0.14, 0.12, -0.02),
        stereo="drone/left",
        baseline=0.1,
        orientation=turned,
        **more,
    )
    return Rig("drone", (camera("left", lens, **more), right), IMU)


ANGLE = 0.08


def true_motion(seconds: Floats) -> tuple[Floats, Rotation]:
    """Return places and rotations of a smooth motion from rest about all axes."""
    share = np.clip(seconds, 0.0, 1.0)
    swell = (share**3 * (10.0 - 15.0 * share + 6.0 * share**2))[:, None]
    places = CENTRE + 0.4 * swell * np.sin(np.outer(seconds, [2.5, 3.2, 2.0]))
    angles = swell * np.sin(np.outer(seconds, [1.1, 1.9, 2.3])) * [0.8, 0.3, 0.3]
    return places, Rotation.from_euler("ZYX", angles)


def twist(seconds: Floats, step: float = 1e-4) -> tuple[Floats, Floats, Floats]:
    """Return velocities and accelerations in the world and angular velocities in the body."""
    (before, turned), (now, _), (after, turning) = (
        true_motion(seconds + d) for d in (-step, 0.0, step)
    )
    rates = (turned.inv() * turning).as_rotvec() / (2 * step)
    return (after - before) / (2 * step), (after - 2 * now + before) / step**2, rates


def flown(*cameras: CameraAnnouncement, length: float = 6.0, images: int = 4) -> _Collector:
    """Return what cameras and an ideal IMU send on that motion, as they announce it."""
    kept = _Collector()
    seconds = np.arange(0.0, length, 0.005)
    places, turns = true_motion(seconds)
    velocities, accelerations, rates = twist(seconds)
    speeds = turns.inv().apply(velocities)
    forces = turns.inv().apply(accelerations - [0.0, 0.0, 9.81])
    for k, second in enumerate(seconds):
        common: dict[str, Any] = {
            "stamp": round(second * 1e9),
            "angular_velocity": vector(rates[k]),
        }
        w, x, y, z = turns[k].as_quat(scalar_first=True).tolist()
        kept.record(
            Odometry(
                source="drone",
                position=vector(places[k]),
                orientation=(w, x, y, z),
                linear_velocity=vector(speeds[k]),
                **common,
            )
        )
        kept.record(Imu(source="drone/imu", linear_acceleration=vector(forces[k]), **common))
    kept.imu_announced = IMU
    motion = Motion(kept.odometry)
    for camera in cameras:
        kept.cameras[camera.source] = camera
        for true in np.linspace(1.2, min(length, 4.0) - 0.2, images):
            expose(kept, camera, motion, round(true * 1e9))
    return kept


def expose(kept: _Collector, camera: CameraAnnouncement, motion: Motion, stamp: int) -> None:
    """Add an image, its depth and the poses of its rows."""
    info = camera.info
    columns, rows = np.meshgrid(np.arange(info.width), np.arange(info.height))
    rays = info.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    places, turns = motion.rows_of(camera, stamp)
    distance, what = hits(ANGLE, places[rows.ravel()], turns[rows.ravel()].apply(rays))
    size = (info.height, info.width)
    kept.images[camera.source][stamp] = np.where(what >= 0, 255, 0).astype(np.uint8).reshape(size)
    depth = (distance * rays[:, 2]).reshape(size)
    kept.vehicle_pixels[camera.source][stamp] = np.zeros(size, np.bool_)
    picked = np.random.default_rng(1).integers(0, depth.size, 300)
    v, u = np.divmod(picked, info.width)
    kept.depths[camera.source][stamp] = np.column_stack([u, v, depth[v, u]])
    half = round(camera.readout * 5e8)
    for row, shift in ((0, -half), (-1, half), (info.height // 2, 0)):
        if shift or row > 0:
            at = np.array([stamp + shift - round(camera.time_offset * 1e9)])
            place, turn = motion.mounted(at, camera.position, camera.orientation)
            w, x, y, z = turn[0].as_quat(scalar_first=True).tolist()
            kept.record(
                PoseStamped(
                    stamp=stamp + shift,
                    source=camera.source,
                    position=vector(place[0]),
                    orientation=(w, x, y, z),
                )
            )


def vector(numbers: Floats) -> Vector3:
    """Return three numbers as a tuple."""
    x, y, z = numbers.tolist()
    return (x, y, z)
