"""Painting points straight into an array of pixels, the nearer over the farther."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Painting = tuple[npt.NDArray[np.uint8], int]

MOST = 1_000_000
"""Points of a cloud that are drawn: their numbers take 20 bits."""

_DEPTHS = 0xFFFFF
_BACKGROUND = np.array([250, 250, 248], np.uint8)


class Shown(msgspec.Struct, frozen=True, eq=False):
    """A cloud as it is drawn.

    Attributes:
        name: Of its file.
        points: East, north, up, metres, float32, shape (n, 3).
        colors: Red, green, blue, uint8, shape (n, 3).
        total: Points in the file.
    """

    name: str
    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]
    total: int


class View(msgspec.Struct, frozen=True, eq=False):
    """An orthographic view.

    Attributes:
        title: What is seen.
        axes: East, north, up to right, up on the image, towards the viewer; shape (3, 3).
        low: Corner of the image, metres right and up, shape (2,).
        high: The opposite corner.
        labels: Of the axes, right and up; none, and an image has a scale bar instead.
    """

    title: str
    axes: Floats
    low: Floats
    high: Floats
    labels: tuple[str, str] | None = None


def visible(cloud: Shown, view: View, pixels: float) -> tuple[Indices, Indices, Indices]:
    """Return the nearest point of each pixel that has one.

    Args:
        cloud: East, north, up; at most `MOST` points.
        view: From where.
        pixels: To a metre.

    Returns:
        Their rows and columns in the image, and their numbers in the cloud; each of shape (m,),
        the farthest first.
    """
    width = _size(view, pixels)[1]
    seen = cloud.points @ view.axes.T.astype(np.float32)
    inside = np.flatnonzero(((seen[:, :2] > view.low) & (seen[:, :2] < view.high)).all(axis=1))
    seen = seen[inside]
    column = ((seen[:, 0] - view.low[0]) * pixels).astype(np.uint64)
    row = ((view.high[1] - seen[:, 1]) * pixels).astype(np.uint64)
    near = seen[:, 2]
    span = float(np.ptp(near)) + 1e-6 if len(near) else 1.0
    depth = ((near - near.min(initial=np.inf)) * (_DEPTHS / span)).astype(np.uint64)
    # One sort of whole numbers (pixel, depth, number of the point) is all the hiding there is.
    keys = np.sort((row * np.uint64(width) + column) << 40 | depth << 20 | inside.astype(np.uint64))
    pixel = keys >> 40
    nearest = np.append(pixel[1:] != pixel[:-1], np.ones(min(len(pixel), 1), bool))
    keys, where = keys[nearest], pixel[nearest].astype(np.int64)
    order = np.argsort(keys >> 20 & 0xFFFFF, kind="stable")
    number = (keys & 0xFFFFF).astype(np.int64)
    return where[order] // width, where[order] % width, number[order]


def paint(cloud: Shown, view: View, pixels: float, dot: int | None = None) -> Painting:
    """Return what a view shows of a cloud as an image, shape (h, w, 3), and its width of dots.

    Args:
        cloud: East, north, up; with colours.
        view: From where.
        pixels: To a metre.
        dot: Width of a point in pixels; as wide as fills gaps between them, if not given.
    """
    height, width = _size(view, pixels)
    row, column, number = visible(cloud, view, pixels)
    if dot is None:
        dot = int(np.clip(np.ceil(np.sqrt(2.0 * height * width / max(len(row), 1))), 2, 5))
    spread = np.arange(dot) - (dot - 1) // 2
    rows = np.clip(row[:, None, None] + spread[:, None], 0, height - 1)
    columns = np.clip(column[:, None, None] + spread, 0, width - 1)
    image = np.full((height * width, 3), _BACKGROUND)
    # Where several dots lie on one pixel, numpy keeps the last: the nearest.
    painted = np.repeat(cloud.colors[number], dot * dot, axis=0)
    image[(rows * width + columns).reshape(-1)] = painted
    return image.reshape(height, width, 3), dot


def _size(view: View, pixels: float) -> tuple[int, int]:
    """Return an image's height and width in pixels."""
    across, up = np.maximum(np.ceil((view.high - view.low) * pixels), 1).astype(int).tolist()
    return up, across
