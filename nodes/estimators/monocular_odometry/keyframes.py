"""Corners of an image, and key frames that are stored for relocalization."""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np

from nodes.estimators.odometry.images import Floats, Grey


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """An image and its landmarks.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
        landmarks: Points in the world, shape (n, 3).
        pixels: Their pixels in the image, shape (n, 2).
    """

    image: Grey
    pose: Floats
    landmarks: Floats
    pixels: Floats


BORDER = 12
"""Pixels at the edge of the image without new corners: optical flow needs a neighbourhood."""
SPACING = 12
"""Pixels between corners."""
_QUALITY = 0.005


def new_corners(image: Grey, taken: Floats, count: int) -> Floats:
    """Return up to `count` corners that keep away from other ones.

    Args:
        image: Grey.
        taken: The other corners: column and row, shape (k, 2).
        count: At least one.

    Returns:
        Column and row, shape (n, 2).
    """
    mask = np.zeros_like(image)
    mask[BORDER:-BORDER, BORDER:-BORDER] = 255
    for column, row in np.rint(taken).astype(int).tolist():
        cv2.circle(mask, (column, row), SPACING, 0, -1)
    found: Any = cv2.goodFeaturesToTrack(image, count, _QUALITY, SPACING, mask=mask, blockSize=5)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
