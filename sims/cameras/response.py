"""What lens, shutter and response curve make of the light of an image.

What the image sensor makes of it is in `sims.cameras.development`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events.camera_info import response_light

_GAMMA = 2.2


def read_response(name: str) -> tuple[float, ...]:
    """Return the light of each of the 256 grey levels, as a `CameraAnnouncement` has it.

    Args:
        name: ``srgb``, for which the result is empty; ``linear``; ``gamma``, of 2.2; or the path of
            a ``pcalib.txt`` of TUM's monoVO data set: 256 rising numbers.

    Raises:
        ValueError: The file is missing or holds something else.
    """
    if name == "srgb":
        return ()
    if name in {"linear", "gamma"}:
        curve = np.linspace(0.0, 1.0, 256) ** (_GAMMA if name == "gamma" else 1.0)
        return tuple(curve.tolist())
    try:
        response = tuple(map(float, Path(name).read_text(encoding="utf-8").split()))
        response_light(response or (0.0,))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"response: expected srgb, linear, gamma or a file of 256 rising numbers, found "
            f"{name}: {error}"
        ) from None
    return response


def noise_at(light: npt.NDArray[np.float64], level: int, noise: float, electrons: float) -> float:
    """Return the standard deviation of an image's noise at a grey level, grey levels.

    Args:
        light: Of each grey level, shape (256,).
        level: 1 to 254.
        noise: What is the same at all levels, grey levels.
        electrons: Of a white pixel, for the shot noise; 0 if there is none.
    """
    levels_per_light = 2.0 / (light[level + 1] - light[level - 1])
    shot = levels_per_light * np.sqrt(light[level] / electrons) if electrons else 0.0
    return float(np.hypot(noise, shot))


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
