"""Drawings of a camera: what they are, and how many a moving camera needs."""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from sims.cameras.lens import Maps, pixel_rays

Colours = npt.NDArray[np.uint8]
Depths = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int32]

RANGE = 500.0  # metres; depth beyond it is ``inf``
CREASE = 1e-3  # least second difference of the inverse depth, as a share, between two surfaces


class Drawn(NamedTuple):
    """Requested images of a camera, for some of its rows."""

    colours: Colours | None  # uint8, shape (rows, width, 3); black where no ray falls on the image
    # float32 planar depth of the optical frame, metres, shape (rows, width); ``inf`` where nothing
    # is, and 90° or more off the axis, where it would not be positive.
    depth: Depths | None
    numbers: Numbers | None  # int32 object numbers, shape (rows, width); -1 where nothing is


class View(msgspec.Struct, frozen=True):
    """View of a camera; `framed`: the model's camera has just this frame."""

    info: CameraInfo
    framed: bool = False


def stacked(pieces: list[Drawn]) -> Drawn:
    """Return bands of rows, from the top, joined into an image."""
    if len(pieces) == 1:
        return pieces[0]
    colours, depth, numbers = zip(*pieces, strict=True)
    return Drawn(*(None if p[0] is None else np.concatenate(p) for p in (colours, depth, numbers)))


def looked_up(drawn: Drawn, columns: Maps, rows: Maps) -> Drawn:
    """Return images whose pixels lie at other places of the given ones, shape (h, w) each.

    Colours are interpolated, numbers are the nearest pixel's. Of depth the inverse, linear on any
    plane, is interpolated; where surfaces meet it is the nearest pixel's.
    """
    colours, depth, numbers = drawn
    if colours is not None:
        colours = np.asarray(cv2.remap(colours, columns, rows, cv2.INTER_LINEAR), np.uint8)
    if depth is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.reciprocal(depth)  # 0 where nothing is
            bent = ~(np.abs(cv2.Laplacian(inverse, cv2.CV_32F)) <= CREASE * inverse)
            rough = cv2.remap(np.where(bent, np.uint8(255), np.uint8(0)), columns, rows, 1)
            nearest = cv2.remap(inverse, columns, rows, cv2.INTER_NEAREST)
            smooth = cv2.remap(inverse, columns, rows, cv2.INTER_LINEAR)
            inverse = np.where(rough > 0, nearest, smooth)
            depth = np.asarray(np.reciprocal(inverse), np.float32)
    if numbers is not None:
        numbers = np.asarray(
            cv2.remap(numbers, columns, rows, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, -1),
            np.int32,
        )
    return Drawn(colours, depth, numbers)


Floats = npt.NDArray[np.float64]

OFF = 0.25  # largest shift of a row drawn at another row's time, pixels

FINER_FOR_DEPTH = 2.5
"""Times as many bands where depth is wanted: on a slanted floor a pixel is some centimetres."""

MOST_BANDS = 128  # most bands per image; beyond 64 pixels of motion in a readout, rows exceed `OFF`
SAMPLES = 32  # longer side of the small image for motion measurement, pixels


def row_time(readout: float, row: float, height: int) -> float:
    """Return the seconds from an image's stamp to the middle of a row's exposure."""
    return readout * (row / (height - 1) - 0.5) if height > 1 else 0.0


def row_bands(height: int, shift: float) -> list[tuple[int, int]]:
    """Return bands of rows (first, last + 1) for an image's shift in the readout (pixels)."""
    count = min(max(math.ceil(0.5 * shift / OFF), 1), height, MOST_BANDS)
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))


def small_camera(info: CameraInfo) -> CameraInfo:
    """Return a camera with the same view and few pixels."""
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


_rays = functools.lru_cache(maxsize=64)(lambda small: pixel_rays(small).reshape(-1, 3))


def image_speeds(
    info: CameraInfo,
    small: CameraInfo,
    depth: npt.NDArray[np.float32],
    poses: list[Floats],
    seconds: float,
) -> Floats:
    """Return the greatest speed of each point that stays in sight, pixels per second, shape (n,).

    Args:
        depth: Planar depth as the small camera sees it at the middle pose, shape (h, w).
        poses: The optical frame in ``map``, (4, 4), at an odd number of times at equal intervals.
    """
    rays = _rays(small)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = depth.reshape(-1) / rays[:, 2]
    points = rays * np.where(np.isfinite(scale), scale, RANGE)[:, None]
    middle = poses[len(poses) // 2]
    points = points[np.isfinite(points).all(axis=1)] @ middle[:3, :3].T + middle[:3, 3]
    places = np.array([info.project((points - pose[:3, 3]) @ pose[:3, :3]) for pose in poses])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
    steps = steps[:, np.isfinite(steps).all(axis=0)].max(axis=0, initial=0.0)
    return np.append(steps * (len(poses) - 1) / seconds, 0.0)
