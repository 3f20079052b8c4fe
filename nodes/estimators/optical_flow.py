"""Optical flow of corners, checked by following them back."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from nodes.estimators.images import Floats, Grey, inside

FLOW_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
"""When the iterations of optical flow end: after 20, or at a step of 0.01 pixels."""
_ROUND_TRIP = 0.5  # largest error of a corner followed there and back, pixels


def follow_both_ways(
    image: Grey,
    other: Grey,
    pixels: Floats,  # column and row, shape (n, 2), n > 0
    guess: Floats,  # their approximate pixels in the other image, shape (n, 2)
    window: int,  # side of the compared neighbourhood, pixels
    levels: int,  # halvings of the images
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Follow corners from a guess, and back; return pixels (n, 2), and a mask of good ones (n,)."""
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    options: Any = {
        "winSize": (window, window),
        "maxLevel": levels,
        "criteria": FLOW_CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    forward, arrived, _ = cv2.calcOpticalFlowPyrLK(
        image, other, start, guess.astype(np.float32).reshape(-1, 1, 2), **options
    )
    backward, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, forward, start.copy(), **options)
    miss = np.abs(backward - start).reshape(-1, 2).max(axis=1)
    points = forward.reshape(-1, 2).astype(np.float64)
    good = (arrived.ravel() == 1) & (returned.ravel() == 1) & (miss < _ROUND_TRIP)
    return points, good & inside(points, image.shape, 3)
