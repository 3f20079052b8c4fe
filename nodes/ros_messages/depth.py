"""Depth as compressed_depth_image_transport sends it: inverse depth in 16 bits, as PNG.

A depth z becomes ``a / z + b`` with ``a = q (q + 1)`` and ``b = 1 - a / z_max``; 0 stands for none.
Twelve bytes come before the PNG: an int32 0 (inverse depth), and a and b as float32. (Its
codec.cpp; ``q`` is its ``depth_quantization``, 100, and ``z_max`` its ``depth_max``, 10 m.)
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
import numpy.typing as npt

from nodes.ros_messages.images import make_header
from nodes.ros_messages.typestore import TypeStore

COMPRESSED = "sensor_msgs/msg/CompressedImage"

DEPTH_HEAD = struct.Struct("<iff")
"""Before the PNG: the format (0: inverse depth), a and b; zeros for whole millimetres."""

_INVERSE_DEPTH = 0
_LARGEST = 65535.0
_FORMAT = "32FC1; compressedDepth png"
_QUICK = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class CompressedDepthWriter:
    """Writes ``sensor_msgs/msg/CompressedImage``.

    Args:
        store: Of the types.
        frame_id: Optical frame.
        farthest: Metres; what is farther away becomes unknown.
        quantization: Larger for finer steps; what is nearer than about q² / 65535 m appears
            to be there.
    """

    def __init__(
        self, store: TypeStore, frame_id: str, farthest: float, quantization: float
    ) -> None:
        self._store = store
        self._frame_id = frame_id
        self._farthest = np.float32(farthest)
        self._a = np.float32(quantization * (quantization + 1.0))
        self._b = np.float32(1.0) - self._a / self._farthest

    def write(self, stamp: tuple[int, int], depth: npt.NDArray[np.float32]) -> bytearray:
        """Return the message.

        Args:
            stamp: Seconds and nanoseconds.
            depth: Metres, shape (height, width); ``inf`` where there is none.
        """
        there = (depth > 0.0) & (depth < self._farthest)
        steps = np.rint(self._a / np.where(there, depth, self._farthest) + self._b)
        inverse = np.where(there, np.minimum(steps, _LARGEST), 0.0).astype(np.uint16)
        _, png = cv2.imencode(".png", inverse, _QUICK)
        head = DEPTH_HEAD.pack(_INVERSE_DEPTH, self._a, self._b)
        message = self._store.message("sensor_msgs/msg/CompressedImage")(
            header=make_header(self._store, stamp, self._frame_id),
            format=_FORMAT,
            data=np.frombuffer(head + png.tobytes(), np.uint8),
        )
        return self._store.serialize(message)
