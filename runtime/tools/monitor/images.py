"""The newest image of a camera as a small JPEG, made in a thread and only when a page asks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from events import Image

MAX_SIDE = 480
"""Pixels of an encoded image's longer side at most."""

PERIOD = 0.25
"""Real seconds between two encoded images of a camera at least, however many pages ask."""

QUALITY = 75
"""Quality of the JPEG, of 100."""


class ImageEncoder:
    """Encodes images beside the run's loop, at most one per camera and `PERIOD`."""

    def __init__(self) -> None:
        self._encoded: dict[str, tuple[float, bytes]] = {}
        self._lock = asyncio.Lock()

    async def encode(self, camera: str, newest: Callable[[], Awaitable[Image]]) -> bytes:
        """Return the JPEG of a camera's newest image.

        Args:
            camera: Name of the camera.
            newest: Gets its newest image; not called if the last JPEG is younger than `PERIOD`.
        """
        async with self._lock:
            now = time.monotonic()
            made, jpeg = self._encoded.get(camera, (-np.inf, b""))
            if now - made >= PERIOD:
                image = await newest()
                jpeg = await asyncio.to_thread(small_jpeg, image.data)
                self._encoded[camera] = now, jpeg
            return jpeg


def small_jpeg(data: npt.NDArray[np.uint8]) -> bytes:
    """Return an image as JPEG, made smaller where a side is longer than `MAX_SIDE` pixels.

    Args:
        data: Pixels, shape (height, width, 3) in RGB, or (height, width) in grey.
    """
    import cv2  # not before somebody asks for an image

    pixels: Any = data
    height, width = data.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale < 1.0:
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if data.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
