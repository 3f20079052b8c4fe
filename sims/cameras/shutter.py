"""A rolling shutter: when each row is exposed, and how many drawings that takes."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from sims.cameras.lens import pixel_rays
from sims.cameras.stage import RANGE

Floats = npt.NDArray[np.float64]

OFF = 0.25
"""Pixels by which a row may be off because it is drawn at the time of another one."""

FINER_FOR_DEPTH = 2.5
"""Times as many bands where depth is wanted: on a slanted floor a pixel is some centimetres."""

MOST_BANDS = 128
"""Bands of one image, at most; beyond 64 pixels of motion in a readout, rows are farther off."""

SAMPLES = 32
"""Pixels along the longer side of the small image by which motion is measured."""


def row_time(readout: float, row: float, height: int) -> float:
    """Return the seconds from an image's stamp to the middle of a row's exposure."""
    return readout * (row / (height - 1) - 0.5) if height > 1 else 0.0


def row_bands(height: int, shift: float) -> list[tuple[int, int]]:
    """Return bands of rows, each to be drawn at the time of its middle.

    Args:
        height: Rows of the image.
        shift: Pixels by which the image moves during the readout.

    Returns:
        First row, and the one after the last, of each band; at least one.
    """
    count = min(max(math.ceil(0.5 * shift / OFF), 1), height, MOST_BANDS)
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))


def small_camera(info: CameraInfo) -> CameraInfo:
    """Return a camera that sees the same with few pixels."""
    share = min(SAMPLES / max(info.width, info.height), 1.0)
    width, height = max(round(info.width * share), 1), max(round(info.height * share), 1)
    across, down = width / info.width, height / info.height
    return msgspec.structs.replace(
        info,
        width=width,
        height=height,
        fx=info.fx * across,
        fy=info.fy * down,
        cx=(info.cx + 0.5) * across - 0.5,
        cy=(info.cy + 0.5) * down - 0.5,
    )


def image_speeds(
    info: CameraInfo,
    small: CameraInfo,
    depth: npt.NDArray[np.float32],
    poses: list[Floats],
    seconds: float,
) -> Floats:
    """Return how quickly what a camera sees moves through its image, pixels per second.

    Args:
        info: The camera.
        small: From `small_camera`.
        depth: Planar depth as the small camera sees it at the middle pose, shape (h, w).
        poses: The optical frame in ``map`` at an odd number of times at equal intervals, shape
            (4, 4) each.
        seconds: From the first to the last of them.

    Returns:
        The greatest speed of each point that stays in sight, shape (n,); zero if there is none.
    """
    rays = pixel_rays(small).reshape(-1, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = depth.reshape(-1) / rays[:, 2]
    points = rays * np.where(np.isfinite(scale), scale, RANGE)[:, None]
    middle = poses[len(poses) // 2]
    points = points[np.isfinite(points).all(axis=1)] @ middle[:3, :3].T + middle[:3, 3]
    places = np.array([info.project((points - pose[:3, 3]) @ pose[:3, :3]) for pose in poses])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
    steps = steps[:, np.isfinite(steps).all(axis=0)].max(axis=0, initial=0.0)
    return np.append(steps * (len(poses) - 1) / seconds, 0.0)
