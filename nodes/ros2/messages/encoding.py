"""Images and depth images as JPEG and PNG."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt


def encode_image(
    data: npt.NDArray[np.uint8], format_: Literal["jpeg", "png"], quality: int = 90
) -> npt.NDArray[np.uint8]:
    """Return the bytes of an encoded image.

    Args:
        data: Pixels, shape (height, width, 3) in RGB, or (height, width) in grey.
        format_: ``png`` loses nothing.
        quality: Of a JPEG, 1 to 100.
    """
    pixels: Any = cv2.cvtColor(data, cv2.COLOR_RGB2BGR) if data.ndim == 3 else data
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if format_ == "jpeg" else []
    return np.asarray(cv2.imencode(f".{format_}", pixels, options)[1], np.uint8).ravel()


def depth_in_steps(depth: npt.NDArray[np.float32], per_metre: float) -> npt.NDArray[np.uint16]:
    """Return depth as whole steps of 16 bits; 0 where there is none, or more than 65535 steps.

    Args:
        depth: Metres; ``inf`` where there is none.
        per_metre: Steps per metre: 1000 for millimetres.
    """
    steps = np.rint(depth * np.float32(per_metre))
    return np.where((steps >= 1.0) & (steps <= 65535.0), steps, 0.0).astype(np.uint16)


def encode_depth(steps: npt.NDArray[np.uint16]) -> bytes:
    """Return steps of depth, shape (height, width), as a quickly made PNG of 16 bits."""
    return cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
