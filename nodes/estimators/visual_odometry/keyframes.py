"""Key frames: where landmarks were first seen, and by which a lost camera is relocalized.

Landmarks are corners, the best of each square of the image that has none yet: J. Shi and C. Tomasi,
"Good Features to Track", CVPR 1994: where the smaller eigenvalue of the structure tensor is large,
a patch cannot slide unnoticed.
"""

from __future__ import annotations

import functools

import cv2
import msgspec
import numpy as np

from events.geometry import inverse
from nodes.estimators.odometry.images import Depth, Floats, Grey
from nodes.estimators.odometry.pose import rays
from nodes.estimators.odometry.relocalization import DescribedPoints, detect_and_describe
from nodes.estimators.visual_odometry.surfaces import surfaces_at

ORB_POINTS = 500
"""Points by which an image is described."""


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """An image in which landmarks were first seen.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
    """

    image: Grey
    pose: Floats


class Described:
    """A key frame's points for relocalization, described when a lost camera first asks for them.

    Args:
        frame: The key frame.
        inverse_of: Its inverse depth, as `inverse_depth` gives it; released once described.
        matrix: K, shape (3, 3).
        noise: Standard deviation of inverse depth, 1/m.
    """

    def __init__(self, frame: Keyframe, inverse_of: Depth, matrix: Floats, noise: float) -> None:
        self._source: tuple[Keyframe, Depth] | None = frame, inverse_of
        self._matrix = matrix
        self._noise = noise

    @functools.cached_property
    def points(self) -> DescribedPoints:
        """The points, in the world."""
        assert self._source is not None
        (frame, inverse_of), self._source = self._source, None
        pixels, descriptors = detect_and_describe(frame.image, ORB_POINTS)
        seen = surfaces_at(inverse_of, pixels, self._noise)
        continuous, back = seen.continuous, inverse(frame.pose)
        points = rays(pixels[continuous], self._matrix) / seen.inverse[continuous, None]
        return DescribedPoints(points @ back[:3, :3].T + back[:3, 3], descriptors[continuous])


RIM = 12
"""Pixels at the edge of the image without corners: patches need a neighbourhood."""
_APART = 10
"""Least distance of a new corner from another one, pixels."""
_BLOCK = 5
_TEXTURE = 1.5e-4
"""Least eigenvalue of a corner, as OpenCV scales it: more than noise of two grey levels gives."""


def squares(pixels: Floats, spacing: int) -> Floats:
    """Return the number of the square that each pixel lies in, shape (n,)."""
    column, row = np.floor(pixels.T / spacing)
    return np.asarray(row * 65536 + column)


def find_corners(image: Grey, spacing: int, taken: Floats) -> Floats:
    """Return corners in squares that hold none, as whole pixels (column, row), shape (n, 2).

    Args:
        image: Grey, shape (h, w).
        spacing: Side of a square, pixels.
        taken: Other corners, column and row, shape (m, 2).
    """
    strength = np.asarray(cv2.cornerMinEigenVal(image, _BLOCK))
    height, width = image.shape
    mask = np.zeros((height, width), bool)
    mask[RIM : height - RIM, RIM : width - RIM] = True
    for column, row in np.rint(taken).astype(int).tolist():
        mask[
            max(row - _APART, 0) : row + _APART + 1, max(column - _APART, 0) : column + _APART + 1
        ] = 0
    down, across = -(-height // spacing), -(-width // spacing)
    whole = np.zeros((down * spacing, across * spacing), np.float32)
    whole[:height, :width] = np.where(mask, strength, 0)
    blocks = whole.reshape(down, spacing, across, spacing).swapaxes(1, 2).reshape(-1, spacing**2)
    best = blocks.argmax(axis=1)
    square = np.arange(len(blocks))
    found = np.stack(
        [square % across * spacing + best % spacing, square // across * spacing + best // spacing],
        axis=1,
    )
    found = found[blocks[square, best] > _TEXTURE].astype(np.float64)
    free = ~np.isin(squares(found, spacing), squares(taken, spacing))
    return np.asarray(found[free])
