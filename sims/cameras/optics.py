"""What a lens and a shutter do to a picture. What a sensor adds is in `sims.cameras.noise`."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]

MOST = 9
"""Renderings of one exposure, at most: each costs as much as a picture without motion blur."""


def defocused(image: Picture, sigma: float) -> Picture:
    """Return the image seen through a lens whose point spread is a Gaussian of `sigma` pixels."""
    if sigma <= 0.0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8)


def moments(exposure: float, shift: float) -> list[float]:
    """Return when to draw what a moving camera sees, so that a step is about a pixel.

    Args:
        exposure: Seconds that the shutter is open.
        shift: Pixels by which the picture moves meanwhile.

    Returns:
        An odd number of moments, seconds from the middle of the exposure, in order: the middles
        of as many equal parts of it.
    """
    count = 2 * math.ceil((min(shift, MOST) - 1.0) / 2.0) + 1 if shift > 1.0 else 1
    return [exposure * ((k + 0.5) / count - 0.5) for k in range(count)]


def mean(pictures: list[Picture]) -> Picture:
    """Return the mean of pictures of one shape, rounded."""
    total = np.zeros(pictures[0].shape, np.uint16)
    for picture in pictures:
        total += picture
    return ((total + len(pictures) // 2) // len(pictures)).astype(np.uint8)
