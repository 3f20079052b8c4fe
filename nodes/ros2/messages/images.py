"""Images and point clouds as messages, JPEG and PNG, and their pixels back.

Nearly all of such a message is its data, so the rest is serialised once by `typestore`, and then
only stamp, length and data are written, into a buffer that is used again: an image is copied once
at most. The bytes are those that rosbags would make. A writer belongs to one topic and one thread
at a time.

Compressed depth is a PNG of 16 bits, as compressed_depth_image_transport has it (its codec.cpp),
after twelve bytes: an int32 0 (inverse depth), then a and b as float32. 0 stands for no depth.

- ``32FC1``: a depth z becomes ``a / z + b`` with ``a = q (q + 1)`` and ``b = 1 - a / z_max``. Here
  ``q`` is its setting ``depth_quantization``, 100, and ``z_max`` its ``depth_max``, 10 m.
- ``16UC1``: whole millimetres, up to 65.535 m; all twelve bytes are zero.
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from events import LidarScan
from nodes.ros2.messages.typestore import Time, TypeStore


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


COMPRESSED = "sensor_msgs/msg/CompressedImage"

_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""A header is the first field of each of these messages, and begins with the stamp."""
_LENGTH = struct.Struct("<I")

_NONE = np.zeros(0, np.uint8)

POINT = np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("_", "u1")])
"""A point of a cloud's PointCloud2: its colour is one field, ``rgb``, as PCL packs it."""

LIDAR_POINT = np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
"""A point of a lidar's PointCloud2, with the fields that Velodyne's driver writes, and that LIO-SAM
and FAST-LIO read: ``time`` is seconds after the message's stamp, which is that of the first ray."""

_FLOAT32, _UINT16 = 7, 4
"""Of sensor_msgs/msg/PointField."""

_XYZ = [("x", 0, _FLOAT32), ("y", 4, _FLOAT32), ("z", 8, _FLOAT32)]
_COLOURED = [*_XYZ, ("rgb", 12, _FLOAT32)]
_MEASURED = [*_XYZ, ("intensity", 12, _FLOAT32), ("ring", 16, _UINT16), ("time", 18, _FLOAT32)]

_PIXEL_BYTES = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
_TURNS = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
}


class ImageWriter:
    """Writes ``sensor_msgs/msg/Image``.

    Args:
        frame_id: Optical frame.
        encoding: ``rgb8``, ``mono8``, ``32FC1``, ``32SC1``; ``16UC1``: metres to millimetres.
    """

    def __init__(self, store: TypeStore, frame_id: str, encoding: str) -> None:
        self._store = store
        self.frame_id = frame_id
        self.encoding = encoding
        self._shape: tuple[int, ...] | None = None
        self._buffer = bytearray()

    def write(self, time: Time, data: npt.NDArray[Any]) -> bytearray:
        """Return the message; it is overwritten by the next.

        Args:
            time: Seconds and nanoseconds.
            data: Pixels, shape (height, width) or (height, width, channels).
        """
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


class CompressedWriter:
    """Writes ``sensor_msgs/msg/CompressedImage`` as image_transport's plugin does.

    Args:
        frame_id: Optical frame.
        quality: Of a JPEG, 1 to 100.
    """

    def __init__(
        self, store: TypeStore, frame_id: str, format_: Literal["jpeg", "png"], quality: int
    ) -> None:
        self._store = store
        self._frame_id = frame_id
        self._format = format_
        self._quality = quality

    def write(self, time: Time, data: npt.NDArray[np.uint8]) -> bytearray:
        """Return the message.

        Args:
            time: Seconds and nanoseconds.
            data: Pixels, shape (height, width, 3) in RGB, or (height, width).
        """
        colour = data.ndim == 3
        format_ = f"{'rgb8' if colour else 'mono8'}; {self._format} compressed "
        message = self._store.message(COMPRESSED)
        return self._store.serialize(
            message(
                header=self._store.header(time, self._frame_id),
                format=format_ + ("bgr8" if colour else "mono8"),
                data=encode_image(data, self._format, self._quality),
            )
        )


class CloudWriter:
    """Writes ``sensor_msgs/msg/PointCloud2``."""

    def __init__(self, store: TypeStore, frame_id: str) -> None:
        self._store = store
        self._frame_id = frame_id

    def cloud(
        self, time: Time, points: npt.NDArray[np.float32], colors: npt.NDArray[np.uint8]
    ) -> bytearray:
        """Return the message of a cloud, with the fields x, y, z and rgb.

        Args:
            time: Seconds and nanoseconds.
            points: Metres in ROS's axes, shape (n, 3).
            colors: Red, green, blue, shape (n, 3), or (0, 3) for none: then all are white.
        """
        frame, rows = self._rows(time, points, POINT, _COLOURED)
        rows["bgr"] = colors[:, ::-1] if len(colors) else 255
        return frame

    def scan(self, time: Time, points: npt.NDArray[np.float32], scan: LidarScan) -> bytearray:
        """Return the message of a lidar's turn, with the fields of `LIDAR_POINT`.

        Args:
            time: Seconds and nanoseconds.
            points: Metres in ROS's axes, shape (n, 3).
        """
        frame, rows = self._rows(time, points, LIDAR_POINT, _MEASURED)
        rows["intensity"], rows["ring"], rows["time"] = scan.intensities, scan.rings, scan.times
        return frame

    def _rows(
        self,
        time: Time,
        points: npt.NDArray[np.float32],
        kind: np.dtype[np.void],
        fields: list[tuple[str, int, int]],
    ) -> tuple[bytearray, npt.NDArray[np.void]]:
        """Return a message with its points, and a view of its rows for the rest."""
        count = len(points)
        message = self._store.message("sensor_msgs/msg/PointCloud2")
        field = self._store.message("sensor_msgs/msg/PointField")
        frame = self._store.serialize(
            message(
                header=self._store.header(time, self._frame_id),
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
        begin, size = len(frame), count * kind.itemsize
        _LENGTH.pack_into(frame, begin - 4, size)
        frame += bytearray(size + 1)
        frame[-1] = dense
        rows = np.frombuffer(frame, kind, count, begin)
        rows["xyz"] = points
        return frame, rows


def image_pixels(message: Any) -> npt.NDArray[np.uint8]:
    """Return the pixels of an Image: RGB, shape (height, width, 3), or grey.

    Raises:
        ValueError: The encoding is another, or sizes do not fit each other.
    """
    channels = _PIXEL_BYTES.get(message.encoding)
    if channels is None:
        raise ValueError(
            f"encoding: expected one of {', '.join(_PIXEL_BYTES)}, found {message.encoding!r:.80}"
        )
    pixels = _rows(message, channels).reshape(message.height, message.width, channels)
    turn = _TURNS.get(message.encoding)
    found: npt.NDArray[Any] = pixels[:, :, 0] if channels == 1 else np.ascontiguousarray(pixels)
    return found if turn is None else np.asarray(cv2.cvtColor(pixels, turn), np.uint8)


def depth_pixels(message: Any) -> npt.NDArray[np.float32]:
    """Return the metres of an Image of metres (``32FC1``) or millimetres (``16UC1``).

    What is not known is ``inf``.

    Raises:
        ValueError: The encoding is another, or sizes do not fit each other.
    """
    size = {"32FC1": 4, "16UC1": 2}.get(message.encoding)
    if size is None:
        raise ValueError(f"encoding: expected 32FC1 or 16UC1, found {message.encoding!r:.80}")
    order = ">" if message.is_bigendian else "<"
    rows = np.ascontiguousarray(_rows(message, size)).view(
        f"{order}{'f' if size == 4 else 'u'}{size}"
    )
    metres = rows.astype(np.float32) * np.float32(1.0 if size == 4 else 0.001)
    metres[~(metres > 0.0)] = np.inf
    return metres


def decoded_pixels(code: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Return the pixels of an encoded image, in RGB if it has colours.

    Raises:
        ValueError: It is no image.
    """
    pixels = cv2.imdecode(code, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("not an image")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels


def _rows(message: Any, pixel: int) -> npt.NDArray[np.uint8]:
    """Return an image's bytes, shape (height, width * pixel), without what fills up its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data: npt.NDArray[np.uint8] = message.data
    if height < 1 or width < 1 or step < width * pixel or len(data) != height * step:
        raise ValueError(
            f"expected height * step bytes, and a step of {pixel} bytes a pixel or more, found "
            f"{width} x {height} pixels, a step of {step} and {len(data)} bytes"
        )
    return data.reshape(height, step)[:, : width * pixel]


HEAD = struct.Struct("<iff")

_INVERSE_DEPTH = 0
_MILLIMETRES = 1000.0
_LARGEST = 65535.0


class CompressedDepthWriter:
    """Writes ``sensor_msgs/msg/CompressedImage``.

    Args:
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
