"""Images as the odometries take them: of the announced size, without distortion, grey.

Their corners are followed from one image to another by optical flow, and back.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]


def refuse_distortion(info: CameraInfo) -> None:
    """Raise `ValueError` if a camera's images are distorted."""
    if not info.is_pinhole:
        raise ValueError(
            f"camera: expected images without distortion, found {info.distortion_model} "
            f"with {info.distortion}"
        )


def grey_image(info: CameraInfo, image: npt.NDArray[np.uint8]) -> Grey:
    """Return an image, shape (h, w, 3) red, green, blue, or (h, w), as grey.

    Raises:
        ValueError: The image's size is not that of the camera.
    """
    _check_size(info, "image", image, {(), (3,)})
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def grey_and_depth(
    info: CameraInfo, image: npt.NDArray[np.uint8], depth: Depth
) -> tuple[Grey, Depth]:
    """Return an image as grey, and its depth, both of the camera's size.

    Raises:
        ValueError: One of them has another size.
    """
    _check_size(info, "depth", depth, {()})
    return grey_image(info, image), depth


def inside(pixels: Floats, shape: tuple[int, ...], rim: int) -> npt.NDArray[np.bool_]:
    """Return which pixels, shape (n, 2), are at least `rim` pixels from the edge, shape (n,)."""
    x, y = pixels.T
    return np.asarray((x >= rim) & (x < shape[1] - rim) & (y >= rim) & (y < shape[0] - rim))


def _check_size(
    info: CameraInfo, name: str, array: npt.NDArray[Any], channels: set[tuple[int, ...]]
) -> None:
    if array.shape[:2] != (info.height, info.width) or array.shape[2:] not in channels:
        raise ValueError(
            f"{name}: expected {info.width}×{info.height} pixels, as the camera announced, "
            f"found shape {array.shape}"
        )


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
