"""Images and depth as trackers take them: of the announced size, without distortion, grey."""

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
    """Return an image, (h, w, 3) or (h, w), as grey; a `ValueError` if not of the camera's size."""
    _check_size(info, "image", image, {(), (3,)})
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def grey_and_depth(
    info: CameraInfo, image: npt.NDArray[np.uint8], depth: Depth
) -> tuple[Grey, Depth]:
    """Return grey image and depth; a `ValueError` if one is not of the camera's size."""
    _check_size(info, "depth", depth, {()})
    return grey_image(info, image), depth


def inside(pixels: Floats, shape: tuple[int, ...], rim: int) -> npt.NDArray[np.bool_]:
    """Return a mask, shape (n,), of pixels (n, 2) at least `rim` pixels from the edge."""
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
