"""Images and point clouds as messages, JPEG and PNG, and their pixels back.

The head is serialised once by `typestore`; then only stamp, length and data are written into a
reused buffer: at most one copy. The bytes are as of rosbags. A writer belongs to one topic and one
thread at a time. Compressed depth is a PNG of 16 bits, as compressed_depth_image_transport has it
(its codec.cpp), after twelve bytes: an int32 0 (inverse depth), then a and b as float32. 0 stands
for no depth.

- ``32FC1``: a depth z becomes ``a / z + b`` with ``a = q (q + 1)`` and ``b = 1 - a / z_max``. Here
  ``q`` is its setting ``depth_quantization``, 100, and ``z_max`` its ``depth_max``, 10 m.
- ``16UC1``: whole millimetres, up to 65.535 m; all twelve bytes are zero.
"""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from nodes.ros2.messages.typestore import Time, TypeStore


def encode_image(
    data: npt.NDArray[np.uint8], format_: Literal["jpeg", "png"], quality: int = 90
) -> npt.NDArray[np.uint8]:
    """Return the bytes of an encoded image, RGB (height, width, 3) or grey (height, width)."""
    pixels: Any = cv2.cvtColor(data, cv2.COLOR_RGB2BGR) if data.ndim == 3 else data
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if format_ == "jpeg" else []
    return np.asarray(cv2.imencode(f".{format_}", pixels, options)[1], np.uint8).ravel()


def depth_in_steps(depth: npt.NDArray[np.float32], per_metre: float) -> npt.NDArray[np.uint16]:
    """Return depth (metres, ``inf`` for none) as 16 bits; 0 for none, or more than 65535 steps."""
    steps = np.rint(depth * np.float32(per_metre))
    return np.where((steps >= 1.0) & (steps <= 65535.0), steps, 0.0).astype(np.uint16)


def encode_depth(steps: npt.NDArray[np.uint16]) -> bytes:
    """Return steps of depth, shape (height, width), as a quickly made PNG of 16 bits."""
    return cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


COMPRESSED = "sensor_msgs/msg/CompressedImage"
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4  # a header is the first field of each of these messages, and begins with the stamp
_LENGTH = struct.Struct("<I")
_NONE = np.zeros(0, np.uint8)
POINT = np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("_", "u1")])  # with PCL's colour ``rgb``
LIDAR_POINT = np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
"""Point of a lidar's PointCloud2, as of Velodyne's driver; ``time``: seconds after the stamp."""
_FLOAT32, _UINT16 = 7, 4  # of sensor_msgs/msg/PointField
_XYZ = [("x", 0, _FLOAT32), ("y", 4, _FLOAT32), ("z", 8, _FLOAT32)]
_MEASURED = [("intensity", 12, _FLOAT32), ("ring", 16, _UINT16), ("time", 18, _FLOAT32)]
_PIXEL_BYTES = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
_TURNS = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
}
_MOSAICS = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}
"""Conversions of Bayer's patterns, by the colours of the first two rows' first two pixels."""
_SIXTEEN_BITS = {"mono16", "rgb16", "bgr16", *(f"bayer_{pattern}16" for pattern in _MOSAICS)}
DEPTH_ENCODINGS = ("32FC1", "16UC1")
COLOUR_ENCODINGS = (*_PIXEL_BYTES, *(f"bayer_{pattern}8" for pattern in _MOSAICS), *_SIXTEEN_BITS)


class ImageWriter:
    """Writer of ``sensor_msgs/msg/Image`` in an optical frame; ``16UC1`` from metres."""

    def __init__(self, store: TypeStore, frame_id: str, encoding: str) -> None:
        self._store, self.frame_id, self.encoding = store, frame_id, encoding
        self._shape: tuple[int, ...] | None = None
        self._buffer = bytearray()

    def write(
        self,
        time: Time,  # seconds and nanoseconds
        data: npt.NDArray[Any],  # pixels, shape (height, width) or (height, width, channels)
    ) -> bytearray:
        """Return the message, overwritten by the next call."""
        if self.encoding == "16UC1":
            data = depth_in_steps(data, 1000.0)
        if data.shape != self._shape:
            self._begin(data)
        _STAMP.pack_into(self._buffer, _STAMP_AT, *time)
        np.copyto(self._pixels, data)
        return self._buffer

    def _begin(self, data: npt.NDArray[Any]) -> None:
        message = self._store.message("sensor_msgs/msg/Image")
        head = self._store.serialize(
            message(
                header=self._store.header((0, 0), self.frame_id),
                height=data.shape[0],
                width=data.shape[1],
                encoding=self.encoding,
                is_bigendian=0,
                step=data.nbytes // max(data.shape[0], 1),
                data=_NONE,
            )
        )
        _LENGTH.pack_into(head, len(head) - 4, data.nbytes)
        self._shape = data.shape
        self._buffer = head + bytearray(data.nbytes)
        flat = np.frombuffer(self._buffer, data.dtype.newbyteorder("<"), data.size, len(head))
        self._pixels = flat.reshape(data.shape)


def cloud(
    store: TypeStore, header: Any, points: npt.NDArray[np.float32], kind: np.dtype[np.void]
) -> tuple[bytearray, npt.NDArray[np.void]]:
    """Return a ``sensor_msgs/msg/PointCloud2`` with points (metres in ROS's axes), and its rows."""
    count = len(points)
    field = store.message("sensor_msgs/msg/PointField")
    fields = [*_XYZ, ("rgb", 12, _FLOAT32)] if kind == POINT else [*_XYZ, *_MEASURED]
    frame = store.serialize(
        store.message("sensor_msgs/msg/PointCloud2")(
            header=header,
            height=1,
            width=count,
            fields=[field(name=n, offset=at, datatype=t, count=1) for n, at, t in fields],
            is_bigendian=False,
            point_step=kind.itemsize,
            row_step=kind.itemsize * count,
            data=_NONE,
            is_dense=bool(np.isfinite(points).all()),
        )
    )
    dense = frame.pop()  # follows the data
    start, size = len(frame), count * kind.itemsize
    _LENGTH.pack_into(frame, start - 4, size)
    frame += bytearray(size + 1)
    frame[-1] = dense
    rows = np.frombuffer(frame, kind, count, start)
    rows["xyz"] = points
    return frame, rows


def image_pixels(message: Any) -> npt.NDArray[np.uint8]:
    """Return an Image's pixels, RGB (height, width, 3) or grey; may raise `ValueError`.

    Bayer's patterns are demosaiced (bilinearly, by OpenCV). Of 16 bits the high byte is taken.
    """
    encoding = str(message.encoding)
    if encoding not in COLOUR_ENCODINGS:
        raise ValueError(
            f"encoding: expected one of {', '.join(sorted(COLOUR_ENCODINGS))}, "
            f"found {encoding!r:.80}"
        )
    if encoding in _SIXTEEN_BITS:
        message = _high_bytes(message)
        encoding = f"{encoding[:-2]}8"
    if encoding.startswith("bayer_"):
        mosaic = np.ascontiguousarray(_rows(message, 1))
        return np.asarray(cv2.cvtColor(mosaic, _MOSAICS[encoding[6:10]]), np.uint8)
    channels = _PIXEL_BYTES[encoding]
    pixels = _rows(message, channels).reshape(message.height, message.width, channels)
    turn = _TURNS.get(encoding)
    array: npt.NDArray[Any] = pixels[:, :, 0] if channels == 1 else np.ascontiguousarray(pixels)
    return array if turn is None else np.asarray(cv2.cvtColor(pixels, turn), np.uint8)


def high_byte(pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return the high byte of an image of 16 bits; one of 8 bits as it is."""
    return (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels


def _high_bytes(message: Any) -> Any:
    """Return an Image of 16 bits a channel as one of 8."""
    channels = 3 if message.encoding in {"rgb16", "bgr16"} else 1
    rows = _rows(message, 2 * channels)
    data = np.ascontiguousarray(rows[:, 0 if message.is_bigendian else 1 :: 2])
    return SimpleNamespace(
        height=message.height, width=message.width, step=data.shape[1], data=data.ravel()
    )


def depth_pixels(message: Any) -> npt.NDArray[np.float32]:
    """Return the metres of an Image of metres (``32FC1``) or millimetres (``16UC1``).

    Unknown depth is ``inf``.

    Raises:
        ValueError: The encoding is another, or sizes do not fit each other.
    """
    if message.encoding not in DEPTH_ENCODINGS:
        raise ValueError(f"encoding: expected 32FC1 or 16UC1, found {message.encoding!r:.80}")
    size = 4 if message.encoding == "32FC1" else 2
    order = ">" if message.is_bigendian else "<"
    rows = np.ascontiguousarray(_rows(message, size)).view(
        f"{order}{'f' if size == 4 else 'u'}{size}"
    )
    return known_depth(rows, 1.0 if size == 4 else 0.001)


def known_depth(steps: npt.NDArray[Any], metres_per_step: float) -> npt.NDArray[np.float32]:
    """Return depth in metres; ``inf`` where it is not above 0."""
    metres = steps.astype(np.float32) * np.float32(metres_per_step)
    metres[~(metres > 0.0)] = np.inf
    return metres


def decoded_pixels(code: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Return the pixels of an encoded image, RGB if in colours; a `ValueError` if it is none."""
    pixels = cv2.imdecode(code, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("not an image")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels


def _rows(message: Any, pixel: int) -> npt.NDArray[np.uint8]:
    """Return an image's bytes without padding of rows, shape (height, width * pixel)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data: npt.NDArray[np.uint8] = message.data
    if height < 1 or width < 1 or step < width * pixel or len(data) != height * step:
        raise ValueError(
            f"expected height * step bytes, and a step of {pixel} bytes a pixel or more, found "
            f"{width} x {height} pixels, a step of {step} and {len(data)} bytes"
        )
    return data.reshape(height, step)[:, : width * pixel]


HEAD = struct.Struct("<iff")


def inverse_depth(
    depth: npt.NDArray[np.float32],  # metres, shape (height, width); ``inf`` where there is none
    farthest: float,  # metres, beyond which depth is unknown
    quantization: float,  # larger for finer steps; the least depth is about q² / 65535 m
) -> bytes:
    """Return inverse depth as encoded by compressed_depth_image_transport."""
    most = np.float32(farthest)
    a = np.float32(quantization * (quantization + 1.0))
    b = np.float32(1.0) - a / most
    valid = (depth > 0.0) & (depth < most)
    steps = np.minimum(np.rint(a / np.where(valid, depth, most) + b), 65535.0)
    return HEAD.pack(0, a, b) + encode_depth(np.where(valid, steps, 0.0).astype(np.uint16))


def depth_in_millimetres(depth: npt.NDArray[np.float32]) -> bytes:
    """Return whole millimetres of depth as compressed_depth_image_transport has them."""
    return bytes(HEAD.size) + encode_depth(depth_in_steps(depth, 1000.0))


def decode_compressed(message: Any) -> npt.NDArray[Any]:
    """Return a CompressedImage's pixels, RGB, grey, or depth in metres; may raise `ValueError`."""
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
    valid = steps > 0
    if format_.startswith("16UC1"):
        metres[valid] = steps[valid] * np.float32(0.001)
    elif format_.startswith("32FC1"):
        metres[valid] = np.float32(a) / (steps[valid] - np.float32(b))
    else:
        raise ValueError(f"expected depth of 16UC1 or 32FC1, found {format_!r:.80}")
    return metres
