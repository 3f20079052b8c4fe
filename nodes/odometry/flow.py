"""Following corners from one image to another by optical flow, and back."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from nodes.odometry.images import Floats, Grey, inside

FLOW_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
"""When the iterations of optical flow end: after 20, or at a step of 0.01 pixels."""
_ROUND_TRIP = 0.5
"""Pixels by which a corner that is followed there and back may miss its start."""


def follow_both_ways(
    image: Grey, other: Grey, pixels: Floats, guess: Floats, window: int, levels: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Follow corners from a guess, and back; only those that return to their start are good.

    Args:
        image: Where they are, grey.
        other: Where to look for them, grey.
        pixels: Column and row, shape (n, 2), n > 0.
        guess: Their approximate pixels in the other image, shape (n, 2).
        window: Side of the neighbourhood that is compared, pixels.
        levels: Halvings of the images.

    Returns:
        Their pixels in the other image, shape (n, 2), and which are good, shape (n,).
    """
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    options: Any = {
        "winSize": (window, window),
        "maxLevel": levels,
        "criteria": FLOW_CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, arrived, _ = cv2.calcOpticalFlowPyrLK(
        image, other, start, guess.astype(np.float32).reshape(-1, 1, 2), **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, start.copy(), **options)
    miss = np.abs(back - start).reshape(-1, 2).max(axis=1)
    found = there.reshape(-1, 2).astype(np.float64)
    good = (arrived.ravel() == 1) & (returned.ravel() == 1) & (miss < _ROUND_TRIP)
    return found, good & inside(found, image.shape, 3)
