"""Images as PNG files: colour, grey, and depth in 16 bits."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[Any]

_DEPTH = (cv2.IMWRITE_PNG_COMPRESSION, 1)
"""A third of the default's size, at half as much time again; colours gain nothing by it."""


class ImageFile:
    """An image on its way to a file: call it to write it, from any thread, as often as need be.

    Args:
        path: The file.
        data: The image, as an event has it.
        convert: Makes of it what is written.
    """

    def __init__(self, path: Path, data: Pixels, convert: Callable[[Pixels], Pixels]) -> None:
        self._path = path
        self._data: Pixels | None = data
        self._convert = convert
        self._lock = threading.Lock()

    def __call__(self) -> None:
        """Write the file, unless that is done; if it is being done, wait until it is.

        Raises:
            OSError: It cannot be written.
        """
        with self._lock:
            if self._data is not None:
                image = self._convert(self._data)
                flags = _DEPTH if image.dtype == np.uint16 else ()
                _, code = cv2.imencode(".png", image, flags)
                self._path.write_bytes(code.tobytes())
                self._data = None


def in_colour(data: Pixels) -> Pixels:
    """Return an ``rgb8`` or ``mono8`` image as OpenCV writes it."""
    return cv2.cvtColor(data, cv2.COLOR_RGB2BGR) if data.ndim == 3 else data


def in_grey(data: Pixels) -> Pixels:
    """Return an ``rgb8`` or ``mono8`` image in grey (ITU-R BT.601)."""
    return cv2.cvtColor(data, cv2.COLOR_RGB2GRAY) if data.ndim == 3 else data


def in_16_bits(depth: npt.NDArray[np.float32], factor: float) -> npt.NDArray[np.uint16]:
    """Return depth as whole numbers.

    Args:
        depth: Metres, shape (h, w); ``inf`` where nothing was hit.
        factor: Steps per metre.

    Returns:
        uint16, shape (h, w); 0 where there is none, or more than 65535 steps of it.
    """
    steps = np.rint(depth * np.float32(factor))
    there = np.isfinite(steps) & (steps >= 1.0) & (steps <= 65535.0)
    return np.where(there, steps, 0.0).astype(np.uint16)
