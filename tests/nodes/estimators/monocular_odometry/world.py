"""A small world to fly over: textured tiles at several depths, seen along their normal or askew."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import CameraInfo

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Tile = tuple[float, float, float, float, float]
"""Distance along the world's z, and from where to where in x and in y; metres."""

INFO = CameraInfo.from_fov(256, 192, math.radians(80))
MATRIX = INFO.matrix()
FLAT: tuple[Tile, ...] = ((2.0, -9.0, 9.0, -9.0, 9.0),)
STEPPED: tuple[Tile, ...] = ((3.0, -9.0, 9.0, -9.0, 9.0), (1.8, -9.0, 9.0, -9.0, 0.0))
"""Two planes, each half of the image."""
RELIEF: tuple[Tile, ...] = (
    (2.0, -9.0, 9.0, -9.0, 9.0),
    *((1.5 + 0.1 * i, -1.4 + 1.2 * i, -0.8 + 1.2 * i, -0.9, -0.2) for i in range(3)),
    *((1.7 - 0.1 * i, -0.9 + 1.2 * i, -0.3 + 1.2 * i, 0.2, 0.9) for i in range(3)),
)
"""A floor with boxes on it, along x."""
BOARD: tuple[Tile, ...] = ((20.0, -99.0, 99.0, -99.0, 99.0), (2.0, -9.0, 0.4, -9.0, 9.0))
"""A board that ends on the right, and something far behind it."""
_METRE = 120.0
"""Pixels of texture to a metre, two metres away, for the focal length of `INFO`."""


@cache
def _texture() -> npt.NDArray[np.float32]:
    random = np.random.default_rng(5)
    image = np.full((1024, 1024), 40.0, np.float32)
    for cells in (64, 256):
        noise = random.random((cells, cells), np.float32)
        image += 90 * cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 0, 255)


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0
) -> Floats:
    """Camera in the world: metres right, down, forward; degrees to the right and up."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("yx", [yaw, pitch], degrees=True).as_matrix()
    matrix[:3, 3] = (x, y, z)
    return matrix


def look(camera: Floats, tiles: tuple[Tile, ...] = RELIEF) -> Grey:
    """Return what a camera of this pose (camera to world) sees."""
    return look_with_depth(camera, INFO, tiles)[0]


def look_with_depth(
    camera: Floats, info: CameraInfo, tiles: tuple[Tile, ...]
) -> tuple[Grey, npt.NDArray[np.float32]]:
    """Return what another camera sees, and its depth along the optical axis, in metres."""
    columns, rows = np.meshgrid(np.arange(info.width), np.arange(info.height))
    x, y = (columns - info.cx) / info.fx, (rows - info.cy) / info.fy
    right, down, ahead = (row[0] * x + row[1] * y + row[2] for row in camera[:3, :3])
    right, down = right / ahead, down / ahead
    u, v, nearest = np.zeros(x.shape), np.zeros(x.shape), np.full(x.shape, np.inf)
    for distance, left, end, top, bottom in tiles:
        reach = distance - camera[2, 3]
        tile_u, tile_v = camera[0, 3] + reach * right, camera[1, 3] + reach * down
        hit = (tile_u > left) & (tile_u < end) & (tile_v > top) & (tile_v < bottom)
        hit &= (reach / ahead > 0) & (reach < nearest)
        np.copyto(nearest, reach, where=hit)
        # Another piece of texture at each distance, and as fine in the image.
        np.copyto(u, 2.0 * tile_u / distance + distance, where=hit)
        np.copyto(v, 2.0 * tile_v / distance, where=hit)
    scale = _METRE * info.fx / INFO.fx
    drawn = cv2.remap(
        _texture(),
        (512 + scale * u).astype(np.float32),
        (512 + scale * v).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.rint(drawn).astype(np.uint8), (nearest / ahead).astype(np.float32)
