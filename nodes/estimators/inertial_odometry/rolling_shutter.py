"""Images of a rolling shutter, made into those of a global one by the motion that the IMU felt.

Row v of h rows is exposed at ``readout · (v / (h - 1) - 1/2)`` after the middle one (see
`events.CameraAnnouncement`). A point p of the camera at the middle row is at ``p - t (v + ω × p)``
in the camera at t: so far the image is shifted back, by the depth of each pixel where it is known.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.estimators.odometry.images import Depth, Floats
from nodes.estimators.odometry.pose import rays

_STEP = 8
"""Pixels between two for which the shift is computed."""


class Rows:
    """The shifts of an image's rows.

    Args:
        info: Intrinsics, without distortion.
        readout: Seconds from the first row's exposure to the last row's.
        turn: Angular velocity of the camera in its own axes, rad/s, shape (3,).
        velocity: Of the camera in its own axes, m/s, shape (3,).
    """

    def __init__(self, info: CameraInfo, readout: float, turn: Floats, velocity: Floats) -> None:
        self._info, self._readout, self._turn, self._velocity = info, readout, turn, velocity
        columns, rows = (
            (np.arange(-(-size // _STEP)) + 0.5) * _STEP - 0.5 for size in (info.width, info.height)
        )
        self._pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        self._grid = len(rows), len(columns)
        self._at = np.rint(self._pixels).astype(int).clip(max=(info.width - 1, info.height - 1))

    def image(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return an image as all its rows would have shown it at once, of things far away."""
        return self._moved(image, np.zeros(len(self._pixels)))[0]

    def image_and_depth(
        self, image: npt.NDArray[np.uint8], depth: Depth
    ) -> tuple[npt.NDArray[np.uint8], Depth]:
        """Return image and depth (metres, shape (h, w)) as all rows would have shown them."""
        there = depth[self._at[:, 1], self._at[:, 0]].astype(np.float64)
        known = there > 0.1
        inverse = np.where(known, 1.0 / np.where(known, there, 1.0), 0.0)
        moved, (columns, rows), nearer = self._moved(image, inverse)
        held = cv2.remap(depth, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return moved, np.asarray(held / nearer, np.float32)

    def _moved(
        self, image: npt.NDArray[np.uint8], inverse: Floats
    ) -> tuple[npt.NDArray[np.uint8], tuple[Depth, Depth], Depth]:
        info, middle = self._info, (self._info.height - 1) / 2
        straight = rays(self._pixels, info.matrix())
        motion = self._velocity * inverse[:, None] + np.cross(self._turn, straight)
        source, ahead = self._pixels, np.ones(len(inverse))
        for _ in range(2):  # a shifted pixel is in another row, so of another time
            time = self._readout * (source[:, 1:] - middle) / max(info.height - 1, 1)
            x, y, ahead = (straight - time * motion).T
            source = np.stack([info.fx * x / ahead + info.cx, info.fy * y / ahead + info.cy], 1)
        size = self._grid[1] * _STEP, self._grid[0] * _STEP
        shifts = np.column_stack([source - self._pixels, ahead]).astype(np.float32)
        large = cv2.resize(shifts.reshape(*self._grid, 3), size, interpolation=cv2.INTER_LINEAR)
        large = large[: info.height, : info.width]
        columns = large[..., 0] + np.arange(info.width, dtype=np.float32)
        rows = large[..., 1] + np.arange(info.height, dtype=np.float32)[:, None]
        maps = np.asarray(columns, np.float32), np.asarray(rows, np.float32)
        moved = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.uint8), maps, np.asarray(large[..., 2], np.float32)
