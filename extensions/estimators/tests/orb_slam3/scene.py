"""What tests of ORB-SLAM3 see: a tilted wall with a random image, and a camera that moves there.

The image and its view are related by a homography, depth is where the ray meets the plane: both
are exact. Besides, a node that sees one image again and again, and a stub of ORB-SLAM3's process.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, CameraInfo, Image, ImuAnnouncement
from runtime import Node, Output, Tick, every
from runtime.typed import override
from visnav_estimators.orb_slam3.node import OrbSlam3Result, check_arrays
from visnav_estimators.orb_slam3.settings import Settings

Floats = npt.NDArray[np.float64]

INFO = CameraInfo.from_fov(320, 240, math.radians(70.0))
CAMERA = CameraAnnouncement(
    stamp=0,
    source="drone/front",
    images=("rgb", "depth"),
    info=INFO,
    rate=30.0,
    latency=0.04,
    frame_id="front_optical",
    parent_frame_id="base_link",
    position=(0.15, 0.0, -0.02),
    orientation=(0.5, 0.5, 0.5, 0.5),
)
RIGHT = msgspec.structs.replace(
    CAMERA, source="drone/right", images=("rgb",), position=(0.15, 0.11, -0.02)
)
"""Partner of the camera in a stereo rig."""
IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="base_link",
    gyroscope_noise_density=1.7e-4,
    gyroscope_random_walk=1.9e-5,
    accelerometer_noise_density=2e-3,
    accelerometer_random_walk=3e-3,
)

_NORMAL = np.array([0.25, 0.1, 1.0]) / np.linalg.norm([0.25, 0.1, 1.0])
_DISTANCE = 2.0
"""Of the plane from the first camera, along the normal; metres."""

_MARGIN = 300
"""Pixels of wall beyond what the first camera sees, on each side."""


class View(NamedTuple):
    """One exposure of both eyes; `pose` is the left one in the first one's frame, shape (4, 4)."""

    stamp: int
    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    right: npt.NDArray[np.uint8]
    pose: Floats


def views(count: int, blank: range = range(0)) -> list[View]:
    """Return a flight in front of the wall, to the right and nearer, with blank images in it."""
    wall = _wall()
    return [_view(wall, k, blank=k in blank) for k in range(count)]


@cache
def _wall() -> npt.NDArray[np.uint8]:
    """Return an image with corners of all sizes."""
    rng = np.random.default_rng(5)
    height, width = INFO.height + 2 * _MARGIN, INFO.width + 2 * _MARGIN
    image = np.full((height, width, 3), 128, np.uint8)
    for _ in range(9000):
        x, y = rng.integers(width), rng.integers(height)
        w, h = rng.integers(3, 22, size=2)
        colour = tuple(int(c) for c in rng.integers(20, 235, size=3))
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), colour, -1)
    return image


def _view(wall: npt.NDArray[np.uint8], k: int, *, blank: bool) -> View:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yx", (-0.006 * k, 0.002 * k)).as_matrix()
    pose[:3, 3] = (0.012 * k, -0.003 * k, 0.008 * k)
    rgb, depth = _shot(wall, pose)
    beside = pose.copy()
    beside[:3, 3] += 0.11 * pose[:3, 0]
    right, _ = _shot(wall, beside)
    if blank:
        rgb, right = np.full_like(rgb, 128), np.full_like(rgb, 128)
    return View(round(k * 1e9 / 30), rgb, depth, right, pose)


def _shot(
    wall: npt.NDArray[np.uint8], pose: Floats
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Return what a camera sees from a pose, and its depth."""
    # A ray R K⁻¹ u from c meets n·X = d where X ~ (c nᵀ + (d - n·c) I) R K⁻¹ u.
    rays = pose[:3, :3] @ np.linalg.inv(INFO.matrix())
    centre = pose[:3, 3]
    left = _DISTANCE - _NORMAL @ centre
    to_wall = INFO.matrix() @ (np.outer(centre, _NORMAL) + left * np.eye(3)) @ rays
    to_wall = np.array([[1, 0, _MARGIN], [0, 1, _MARGIN], [0, 0, 1]]) @ to_wall
    size = (INFO.width, INFO.height)
    rgb = cv2.warpPerspective(wall, to_wall, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    u, v = np.meshgrid(np.arange(INFO.width), np.arange(INFO.height))
    along = np.stack([u, v, np.ones_like(u)], -1) @ rays.T @ _NORMAL
    depth = (left / along).astype(np.float32)
    return np.asarray(rgb), depth


class Still(Node):
    """Sends the same image ten times a second."""

    images = Output(Image)

    def __init__(self) -> None:
        self._image = views(1)[0].rgb

    @every(hz=10)
    def show(self, tick: Tick) -> None:
        """Send it."""
        self.images.send(
            Image(stamp=tick.stamp, source=f"{self.name}/front", frame_id="f", data=self._image)
        )


class StubProcess:
    """Takes what `OrbSlam3Process` does; each image is a metre further than the last one.

    The reason of a result names the arrays that came; the final trajectory is half as long.
    """

    def __init__(self, settings: Settings, vocabulary: Path, mapping_timeout: float) -> None:
        self._settings = settings
        self._stamps: list[int] = []

    def track(self, stamp: int, image: Any, depth: Any, right: Any, imu: Any) -> OrbSlam3Result:
        check_arrays(self._settings, image, depth, right, imu)
        pose = np.eye(4)
        pose[2, 3] = len(self._stamps)
        self._stamps.append(stamp)
        lost = len(self._stamps) == 3
        given = {"depth": depth, "right": right, "imu": imu}
        shapes = [f"{name} {a.shape}" for name, a in given.items() if a is not None]
        return OrbSlam3Result(
            pose=pose, lost=lost, reason=", ".join(shapes), first_keyframe=self._stamps[0]
        )

    def trajectory(self) -> tuple[Any, Any]:
        poses = np.tile(np.eye(4), (len(self._stamps), 1, 1))
        poses[:, 2, 3] = 0.5 * np.arange(len(self._stamps))
        return np.array(self._stamps), poses

    def close(self) -> None:
        pass


class UnsavedProcess(StubProcess):
    """Fails to save its trajectory, as ORB-SLAM3 sometimes does."""

    @override
    def trajectory(self) -> tuple[Any, Any]:
        raise RuntimeError("Invalid argument")
