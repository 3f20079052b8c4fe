"""Compressed depth as compressed_depth_image_transport has it (its codec.cpp): 16 bits, as PNG.

Twelve bytes come before the PNG: an int32 0 (inverse depth), then a and b as float32.

- ``32FC1``: a depth z becomes ``a / z + b`` with ``a = q (q + 1)`` and ``b = 1 - a / z_max``. Here
  ``q`` is its setting ``depth_quantization``, 100, and ``z_max`` its ``depth_max``, 10 m.
- ``16UC1``: whole millimetres, up to 65.535 m; all twelve bytes are zero.

In both, 0 stands for no depth.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from nodes.ros2.messages.encoding import depth_in_steps, encode_depth
from nodes.ros2.messages.images import COMPRESSED, decoded_pixels
from nodes.ros2.messages.stamps import Time
from nodes.ros2.messages.typestore import TypeStore

HEAD = struct.Struct("<iff")

_INVERSE_DEPTH = 0
_MILLIMETRES = 1000.0
_LARGEST = 65535.0


class CompressedDepthWriter:
    """Writes ``sensor_msgs/msg/CompressedImage``.

    Args:
        store: Of the types.
        frame_id: Optical frame.
        inverse: Whether inverse depth is written, and not millimetres.
        farthest: Metres; what is farther away becomes unknown. Of inverse depth only.
        quantization: Larger for finer steps; what is nearer than about q² / 65535 m appears
            to be there. Of inverse depth only.
    """

    def __init__(
        self,
        store: TypeStore,
        frame_id: str,
        *,
        inverse: bool = True,
        farthest: float = 10.0,
        quantization: float = 100.0,
    ) -> None:
        self._store = store
        self._frame_id = frame_id
        self._inverse = inverse
        self._farthest = np.float32(farthest)
        self._a = np.float32(quantization * (quantization + 1.0) if inverse else 0.0)
        self._b = np.float32(1.0) - self._a / self._farthest if inverse else np.float32(0.0)
        self._format = f"{'32FC1' if inverse else '16UC1'}; compressedDepth png"

    def write(self, time: Time, depth: npt.NDArray[np.float32]) -> bytearray:
        """Return the message.

        Args:
            time: Seconds and nanoseconds.
            depth: Metres, shape (height, width); ``inf`` where there is none.
        """
        steps = self._steps(depth) if self._inverse else depth_in_steps(depth, _MILLIMETRES)
        head = HEAD.pack(_INVERSE_DEPTH, self._a, self._b)
        message = self._store.message(COMPRESSED)(
            header=self._store.header(time, self._frame_id),
            format=self._format,
            data=np.frombuffer(head + encode_depth(steps), np.uint8),
        )
        return self._store.serialize(message)

    def _steps(self, depth: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
        known = (depth > 0.0) & (depth < self._farthest)
        steps = np.rint(self._a / np.where(known, depth, self._farthest) + self._b)
        return np.where(known, np.minimum(steps, _LARGEST), 0.0).astype(np.uint16)


def decode_compressed(message: Any) -> npt.NDArray[Any]:
    """Return the pixels of a CompressedImage: RGB, grey, or depth in metres.

    Raises:
        ValueError: It is no image, or depth in a form that is not known.
    """
    if "compressedDepth" in message.format:
        return _decoded_depth(message.data, message.format)
    return decoded_pixels(message.data)


def _decoded_depth(code: npt.NDArray[np.uint8], format_: str) -> npt.NDArray[np.float32]:
    if len(code) <= HEAD.size:
        raise ValueError("expected an image, found no more than the head of one")
    _, a, b = HEAD.unpack(code[: HEAD.size].tobytes())
    steps = decoded_pixels(code[HEAD.size :])
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise ValueError(f"expected depth in 16 bits, found {steps.dtype} {steps.shape}")
    metres = np.full(steps.shape, np.inf, np.float32)
    known = steps > 0
    if format_.startswith("16UC1"):
        metres[known] = steps[known] * np.float32(0.001)
    elif format_.startswith("32FC1"):
        metres[known] = np.float32(a) / (steps[known] - np.float32(b))
    else:
        raise ValueError(f"expected depth of 16UC1 or 32FC1, found {format_!r:.80}")
    return metres
