"""Corners: finding them, and following them to another picture by optical flow and back."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from nodes.visual_odometry.tracker import Floats, Grey

_ENDS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_ROUND_TRIP = 0.5
"""Pixels by which a corner followed there and back may miss itself."""
BORDER = 12
"""Pixels at the rim in which no corner begins: optical flow needs a neighbourhood."""
SPACING = 12
"""Pixels between corners."""
_QUALITY = 0.005


def follow_both_ways(
    image: Grey, other: Grey, pixels: Floats, guess: Floats, window: int, levels: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Follow corners from a guess, and back; only those that return to their place are good.

    Args:
        image: Where they are, grey.
        other: Where to look for them, grey.
        pixels: Column and row, shape (n, 2), n > 0.
        guess: About where they are in the other, shape (n, 2).
        window: Side of the neighbourhood that is compared, pixels.
        levels: Halvings of the pictures.

    Returns:
        Where they are in the other, shape (n, 2), and which are good, shape (n,).
    """
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    options: Any = {
        "winSize": (window, window),
        "criteria": _ENDS,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, arrived, _ = cv2.calcOpticalFlowPyrLK(
        image, other, start, guess.astype(np.float32).reshape(-1, 1, 2), maxLevel=levels, **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        other, image, there, start.copy(), maxLevel=levels, **options
    )
    miss = np.abs(back - start).reshape(-1, 2).max(axis=1)
    found = there.reshape(-1, 2).astype(np.float64)
    good = (arrived.ravel() == 1) & (returned.ravel() == 1) & (miss < _ROUND_TRIP)
    return found, good & inside(found, image.shape, 3)


def new_corners(image: Grey, taken: Floats, count: int) -> Floats:
    """Return up to `count` corners that keep away from those that are taken.

    Args:
        image: Grey.
        taken: Column and row, shape (k, 2).
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


def inside(pixels: Floats, shape: tuple[int, ...], rim: int) -> npt.NDArray[np.bool_]:
    """Tell which pixels, shape (n, 2), keep `rim` pixels off the edge of a picture, shape (n,)."""
    x, y = pixels.T
    return np.asarray((x >= rim) & (x < shape[1] - rim) & (y >= rim) & (y < shape[0] - rim))
