"""What to draw for a lens, and where each pixel of its image lies in what was drawn.

A rasteriser draws straight lines as straight lines: pinhole images, here called faces. A lens's
image is looked up in one of them that is wide enough, or, beyond 120°, in those faces of a cube
that it sees. Pure numpy; the drawing is in `sims.cameras.view`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from events import CameraInfo

Floats = npt.NDArray[np.float64]
Maps = npt.NDArray[np.float32]

ONE_FACE = math.radians(61.0)
"""Angle off the axis up to which one face is drawn; farther out its pixels become too many."""

FINER = 1.3
"""Pixels of a face for one of the image, where the image is sharpest."""

MARGIN = 3
"""Pixels of a face around all that is looked up in it."""

LARGEST = 8192
"""Pixels of a face's side, at most."""


class Face(NamedTuple):
    """One pinhole drawing.

    Attributes:
        turn: Its axes (right, down, ahead) in the optical frame, shape (3, 3), one in each row.
        left: Coordinate x/z of the left edge of the first column, in the face's axes.
        top: Coordinate y/z of the upper edge of the first row.
        pitch: Width and height of a pixel, in these coordinates.
        width: Pixels.
        height: Pixels.
        columns: Column of the face on which each pixel of the image falls, shape (h, w); None if
            the face is the image.
        rows: The same of rows.
        mask: The pixels that fall on this face, shape (h, w).
        steepness: Planar depth in the optical frame for a planar depth of 1 in the face, shape
            (h, w); ``inf`` where it would not be positive. None if it is 1.
    """

    turn: Floats
    left: float
    top: float
    pitch: tuple[float, float]
    width: int
    height: int
    columns: Maps | None = None
    rows: Maps | None = None
    mask: npt.NDArray[np.bool_] | None = None
    steepness: Maps | None = None


_CUBE = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)
"""Axes of a cube's faces: ahead, right, left, below, above, behind; shape (6, 3, 3)."""


def faces(info: CameraInfo) -> tuple[Face, ...]:
    """Return what is to be drawn for a camera; empty if no ray falls on its image."""
    if info.is_pinhole:
        pitch = 1.0 / info.fx, 1.0 / info.fy
        left, top = (-0.5 - info.cx) * pitch[0], (-0.5 - info.cy) * pitch[1]
        return (Face(_CUBE[0], left, top, pitch, info.width, info.height),)
    rays = pixel_rays(info)
    seen = np.isfinite(rays[..., 2])
    if not seen.any():
        return ()
    if np.arccos(np.clip(rays[seen][:, 2].min(), -1.0, 1.0)) <= ONE_FACE:
        return (_face(info, rays, seen, _CUBE[0]),)
    ahead = np.where(seen, np.argmax(rays @ _CUBE[:, 2].T, axis=-1), -1)
    return tuple(
        _face(info, rays, ahead == number, _CUBE[number])
        for number in range(len(_CUBE))
        if (ahead == number).any()
    )


def undistorted(info: CameraInfo) -> tuple[CameraInfo, Maps, Maps]:
    """Return the pinhole camera of the same focal length and principal point as a lens.

    Returns:
        The pinhole camera; column and row of the lens's image on which each of its pixels falls,
        shape (h, w) each, outside it where the lens does not see.
    """
    pinhole = CameraInfo(
        width=info.width, height=info.height, fx=info.fx, fy=info.fy, cx=info.cx, cy=info.cy
    )
    places = info.project(pixel_rays(pinhole)).reshape(info.height, info.width, 2)
    return pinhole, _map(places[..., 0]), _map(places[..., 1])


def _map(places: Floats) -> Maps:
    """Return places as `cv2.remap` takes them: far outside where there is none."""
    return np.nan_to_num(places, nan=-100.0).astype(np.float32)


def pixel_rays(info: CameraInfo) -> Floats:
    """Return the ray of each pixel's centre, of length 1, shape (h, w, 3); NaN where none is."""
    rows, columns = np.mgrid[0 : info.height, 0 : info.width]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    return info.unproject(pixels).reshape(info.height, info.width, 3)


def _face(info: CameraInfo, rays: Floats, mask: npt.NDArray[np.bool_], turn: Floats) -> Face:
    """Return the face with some axes on which some pixels' rays, shape (h, w, 3), fall."""
    places = np.full((*mask.shape, 2), np.nan)
    turned = rays[mask] @ turn.T
    places[mask] = turned[:, :2] / turned[:, 2:]
    steps = np.concatenate(
        [np.linalg.norm(np.diff(places, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    )
    steps = steps[np.isfinite(steps)]
    finest = float(steps.min()) if len(steps) else 1.0 / max(info.fx, info.fy)
    left, top = places[mask].min(axis=0)
    right, bottom = places[mask].max(axis=0)
    longest = max(right - left, bottom - top)
    pitch = max(finest / FINER, longest / (LARGEST - 2 * MARGIN - 1))
    left, top = left - (MARGIN + 0.5) * pitch, top - (MARGIN + 0.5) * pitch
    ahead = mask & (rays[..., 2] > 0.0)
    steepness = np.full(mask.shape, np.inf)
    steepness[ahead] = rays[ahead][:, 2] / (rays[ahead] @ turn[2])
    return Face(
        turn=turn,
        left=float(left),
        top=float(top),
        pitch=(pitch, pitch),
        width=math.ceil((right - left) / pitch) + MARGIN + 1,
        height=math.ceil((bottom - top) / pitch) + MARGIN + 1,
        columns=_map((places[..., 0] - left) / pitch - 0.5),
        rows=_map((places[..., 1] - top) / pitch - 0.5),
        mask=mask,
        steepness=None if turn[2, 2] == 1.0 else steepness.astype(np.float32),
    )
