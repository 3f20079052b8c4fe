"""Textures of a mesh: their size, and what lies between the parts of an image that are used."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Places = npt.NDArray[np.float32]
_FINE = 4  # bits of a texel's fraction where triangles are filled


def fitted(image: Image, most: int) -> Image:
    """Return an image of at most so many columns and rows."""
    height, width = image.shape[:2]
    share = most / max(height, width)
    if share >= 1.0:
        return np.ascontiguousarray(image)
    size = max(round(width * share), 1), max(round(height * share), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def extended(image: Image, corners: Places) -> Image:
    """Return an image whose unused texels have the colour of the nearest used one.

    Smaller copies of a texture mix neighbours, and so would draw dark seams where the background of
    an atlas shows. Images that repeat have no unused texels.

    Args:
        corners: u, and v from the top, of the triangles that use it, shape (n, 3, 2).
    """
    if not len(corners) or not np.isfinite(corners).all():
        return image
    if corners.min() < -1e-3 or corners.max() > 1.0 + 1e-3:
        return image
    height, width = image.shape[:2]
    unused = np.full((height, width), 255, np.uint8)
    texels = corners * (width, height) - 0.5
    for triangle in np.rint(texels * (1 << _FINE)).astype(np.int32):
        cv2.fillConvexPoly(unused, triangle, 0, cv2.LINE_8, _FINE)
    if not unused.any() or unused.all():
        return image
    _, labels = cv2.distanceTransformWithLabels(
        unused, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    used = np.flatnonzero(unused == 0)
    texel_of = np.zeros(int(labels.max()) + 1, np.int64)
    texel_of[labels.ravel()[used]] = used
    flat = image.reshape(height * width, -1)
    return np.ascontiguousarray(flat[texel_of[labels]])
