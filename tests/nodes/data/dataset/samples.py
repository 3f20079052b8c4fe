"""A vehicle with cameras and an IMU, as events."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Vector3,
)
from events.base import Quaternion

OPTICAL: Quaternion = (0.5, 0.5, 0.5, 0.5)
"""Optical axes to the body's, for a camera that looks ahead."""


def camera(
    name: str = "front",
    images: tuple[str, ...] = ("rgb", "depth"),
    body: str = "drone",
    parent: str = "base_link",
) -> CameraAnnouncement:
    return CameraAnnouncement(
        stamp=0,
        source=f"{body}/{name}",
        images=images,
        info=CameraInfo(width=4, height=3, fx=5.0, fy=5.5, cx=1.5, cy=1.0),
        rate=30.0,
        latency=0.04,
        frame_id=f"{body}/{name}_optical",
        parent_frame_id=parent,
        position=(0.15, 0.0, 0.05),
        orientation=OPTICAL,
    )


def imu_announcement(body: str = "drone", frame: str = "base_link") -> ImuAnnouncement:
    return ImuAnnouncement(
        stamp=0,
        source=f"{body}/imu",
        rate=200.0,
        frame_id=frame,
        gyroscope_noise_density=1.7e-4,
        gyroscope_random_walk=2e-5,
        accelerometer_noise_density=2e-3,
        accelerometer_random_walk=3e-3,
    )


def image(stamp: int, source: str = "drone/front", *, grey: bool = False) -> Image:
    """Return an image that is another at every stamp."""
    rng = np.random.default_rng(stamp)
    data = rng.integers(0, 255, (3, 4) if grey else (3, 4, 3), np.uint8)
    encoding = "mono8" if grey else "rgb8"
    return Image(stamp=stamp, source=source, frame_id="f", encoding=encoding, data=data)


def depth(stamp: int, source: str = "drone/front") -> DepthImage:
    data = np.full((3, 4), 1.5, np.float32)
    data[0, :3] = [np.inf, 13.1, 13.2]
    return DepthImage(stamp=stamp, source=source, frame_id="f", data=data)


def pose(stamp: int, position: Vector3 = (1.0, 2.0, -3.0), name: str = "front") -> PoseStamped:
    return PoseStamped(stamp=stamp, source=f"drone/{name}", position=position, orientation=OPTICAL)


def odometry(stamp: int, source: str = "drone") -> Odometry:
    """Return a pose that looks east and rises at 1 m/s."""
    half = math.pi / 4
    return Odometry(
        stamp=stamp,
        source=source,
        position=(1.0, 2.0, -3.0),
        orientation=(math.cos(half), 0.0, 0.0, math.sin(half)),
        linear_velocity=(0.5, 0.0, -1.0),
        angular_velocity=(0.0, 0.0, 0.0),
    )


def imu(stamp: int, source: str = "drone/imu") -> Imu:
    rates, force = (0.1, 0.2, 0.3), (0.0, 0.0, -9.81)
    return Imu(stamp=stamp, source=source, angular_velocity=rates, linear_acceleration=force)


def flight(frames: int = 3) -> list[Event]:
    """Return announcements, and 30 ms between frames with one of everything at each."""
    announced: list[Announcement] = [imu_announcement(), camera()]
    said: list[Event] = []
    for stamp in range(0, frames * 30_000_000, 30_000_000):
        said += [imu(stamp), odometry(stamp), pose(stamp), depth(stamp), image(stamp)]
    return [*announced, *said]


def png(path: Path) -> npt.NDArray[Any]:
    """Return an image as it is stored, colours as RGB."""
    data: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert data is not None, path
    return np.asarray(data[..., ::-1] if data.ndim == 3 else data)


def table(path: Path) -> list[list[str]]:
    """Return a file's rows without comments, split at blanks or commas."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line.replace(",", " ").split() for line in lines if not line.startswith("#")]


def yaml(path: Path) -> Any:
    """Return a YAML file, as another library reads it."""
    return importlib.import_module("yaml").safe_load(path.read_text(encoding="utf-8"))
