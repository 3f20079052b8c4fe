"""Effects of lens and shutter on the light of an image.

What the image sensor makes of it is in `sims.cameras.development`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint16]
"""Codes of linear light, shape (height, width, 3) or (height, width)."""

MOST = 9
"""Renderings of one exposure, at most: each costs as much as an image without motion blur."""


def defocused(image: Image, sigma: float) -> Image:
    """Return the image seen through a lens whose point spread is a Gaussian of `sigma` pixels."""
    if sigma <= 0.0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint16)


def moments(exposure: float, shift: float) -> list[float]:
    """Return when to draw what a moving camera sees, so that a step is about a pixel.

    Args:
        exposure: Seconds that the shutter is open.
        shift: Pixels by which the image moves meanwhile.

    Returns:
        An odd number of moments, seconds from the middle of the exposure, in order: the middles
        of as many equal parts of it.
    """
    count = 2 * math.ceil((min(shift, MOST) - 1.0) / 2.0) + 1 if shift > 1.0 else 1
    return [exposure * ((k + 0.5) / count - 0.5) for k in range(count)]


def mean(images: Sequence[Image]) -> Image:
    """Return the mean of images of one shape, rounded."""
    if len(images) == 1:
        return images[0]
    total = np.zeros(images[0].shape, np.float32)  # exact: whole numbers below 2**24
    for image in images:
        cv2.accumulate(image, total)
    share: Any = 1.0 / len(images)
    return np.asarray(cv2.multiply(total, share, dtype=cv2.CV_16U), np.uint16)
