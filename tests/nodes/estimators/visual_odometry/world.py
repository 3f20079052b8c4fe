"""A small world to look at: a textured wall with a box in front of it, drawn with its depth."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import CameraInfo

Floats = npt.NDArray[np.float64]

INFO = CameraInfo.from_fov(320, 240, math.radians(80))
WALL, BOX = 3.0, 2.0
"""Metres to the wall, and to the front of the box."""


@cache
def _textures() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    random = np.random.default_rng(5)
    textures = []
    for _ in range(2):
        coarse = cv2.resize(
            random.random((64, 64), np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC
        )
        fine = cv2.resize(
            random.random((256, 256), np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC
        )
        textures.append(np.clip(40 + 90 * coarse + 90 * fine, 0, 255).astype(np.float32))
    return textures[0], textures[1]


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0
) -> Floats:
    """Camera in the world: metres right, down, forward; degrees to the right and up."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("yx", [yaw, pitch], degrees=True).as_matrix()
    matrix[:3, 3] = (x, y, z)
    return matrix


def look(camera: Floats) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Return what a camera of this pose sees: grey, and depth in metres."""
    columns, rows = np.meshgrid(np.arange(INFO.width), np.arange(INFO.height))
    rays = np.stack(
        [(columns - INFO.cx) / INFO.fx, (rows - INFO.cy) / INFO.fy, np.ones(columns.shape)], axis=-1
    )
    world = rays @ camera[:3, :3].T
    image = np.zeros(columns.shape, np.float32)
    depth = np.full(columns.shape, np.inf)
    for distance, texture, half in ((WALL, _textures()[0], 9.0), (BOX, _textures()[1], 0.5)):
        reach = (distance - camera[2, 3]) / world[..., 2]
        u = camera[0, 3] + reach * world[..., 0]
        v = camera[1, 3] + reach * world[..., 1]
        hit = (reach > 0) & (np.abs(u) < half) & (np.abs(v) < half) & (reach < depth)
        scale = 512 / 4.0  # 4 m of texture from the middle to its edge
        drawn = cv2.remap(
            texture,
            (512 + scale * u).astype(np.float32),
            (512 + scale * v).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        image[hit] = drawn[hit]
        depth[hit] = reach[hit]
    return np.rint(image).astype(np.uint8), depth.astype(np.float32)
