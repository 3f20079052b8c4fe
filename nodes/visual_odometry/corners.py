"""Corners for landmarks: the best of each square of the image that has none yet.

J. Shi and C. Tomasi, "Good Features to Track", CVPR 1994: where the smaller eigenvalue of the
structure tensor is large, a patch cannot slide unnoticed.
"""

from __future__ import annotations

import cv2
import numpy as np

from nodes.odometry.images import Floats, Grey

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
