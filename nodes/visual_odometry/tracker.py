"""What every method of RGB-D odometry takes and gives. Made for a worker process: no asyncio."""

from __future__ import annotations

from typing import Any, Protocol

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]


class Tracked(msgspec.Struct, frozen=True, eq=False):
    """What a tracker says of one picture.

    Attributes:
        pose: The optical camera now, in the optical camera at the first picture, metres,
            shape (4, 4).
        lost: Whether the pose is not known; `pose` is then the last one that was.
        reason: Why it is lost, or how it was regained.
        points: float32 pixels (column, row), shape (n, 2): what was followed.
        inliers: bool, shape (n,): what agrees with the pose.
        matches: How many do.
    """

    pose: Floats
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    matches: int = 0


class Tracker(Protocol):
    """A method of RGB-D odometry."""

    def track(self, stamp: int, image: npt.NDArray[np.uint8], depth: Depth) -> Tracked:
        """Follow the camera by one picture.

        Args:
            stamp: Of the exposure (ns).
            image: Shape (h, w, 3) red, green, blue, or (h, w) grey.
            depth: Metres along the optical axis, shape (h, w); ``inf`` where there is none.

        Raises:
            ValueError: The size is not that of the camera.
        """


def refuse_distortion(info: CameraInfo) -> None:
    """Raise `ValueError` if a camera's pictures are distorted."""
    if any(info.distortion):
        raise ValueError(f"camera: expected pictures without distortion, found {info.distortion}")


def grey_and_depth(
    info: CameraInfo, image: npt.NDArray[np.uint8], depth: Depth
) -> tuple[Grey, Depth]:
    """Return a picture as grey, and its depth, both of the camera's size.

    Raises:
        ValueError: One of them has another size.
    """
    _check_size(info, "depth", depth, {()})
    return grey_picture(info, image), depth


def grey_picture(info: CameraInfo, image: npt.NDArray[np.uint8]) -> Grey:
    """Return a picture, shape (h, w, 3) red, green, blue, or (h, w), as grey.

    Raises:
        ValueError: It has another size than the camera's.
    """
    _check_size(info, "image", image, {(), (3,)})
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _check_size(
    info: CameraInfo, name: str, array: npt.NDArray[Any], channels: set[tuple[int, ...]]
) -> None:
    if array.shape[:2] != (info.height, info.width) or array.shape[2:] not in channels:
        raise ValueError(
            f"{name}: expected {info.width}×{info.height} pixels, as the camera announced, "
            f"found shape {array.shape}"
        )
