"""Events as they are, in a recording: `runtime.wire`'s frames, as messages that ROS can carry.

The message is a ``std_msgs/msg/UInt8MultiArray``, so that a file holds nothing but CDR: ``ros2
bag`` refuses files in which encodings are mixed. Its data is a frame; or, if the arrays stand in
another message of the same time, only the frame's beginning, up to its arrays, which are then
taken from that message.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import Event
from events.frames import Axes, convert_points
from nodes.ros2.messages.depth import decode_compressed
from nodes.ros2.messages.images import COMPRESSED, LIDAR_POINT, POINT
from nodes.ros2.messages.typestore import TypeStore
from runtime.errors import WireError
from runtime.wire import ALIGNED, unpack

TYPE = "std_msgs/msg/UInt8MultiArray"

_LENGTH = struct.Struct("<I")
_HEAD = struct.Struct("<4sIII")
"""CDR's header (little endian), no dimensions, no offset, and the number of bytes."""
_CDR = b"\x00\x01\x00\x00"

_decode = msgspec.msgpack.Decoder(tuple[str, list[tuple[str, list[int], int]], msgspec.Raw]).decode


class Shape(msgspec.Struct, frozen=True):
    """An array that a frame has, or lacks.

    Attributes:
        dtype: As numpy writes it.
        shape: Its lengths.
    """

    dtype: str
    shape: tuple[int, ...]


def message(frame: bytes | bytearray | memoryview, arrays: bool = True) -> bytes:
    """Return a frame as a message.

    Args:
        frame: Of `runtime.wire`.
        arrays: Whether its arrays are to be in it.
    """
    size = len(frame) if arrays else _LENGTH.size + _LENGTH.unpack_from(frame)[0]
    return b"".join((_HEAD.pack(_CDR, 0, 0, size), memoryview(frame)[:size]))


def describe(frame: bytes | bytearray | memoryview) -> tuple[str, str]:
    """Return the kind and the source of a frame's event.

    Raises:
        WireError: It is no frame.
    """
    try:
        (length,) = _LENGTH.unpack_from(frame)
        view = memoryview(frame)[_LENGTH.size : _LENGTH.size + length]
        kind, _, found = _decode(view)
        return kind, _source(found).source
    except (struct.error, msgspec.DecodeError) as error:
        raise WireError(f"expected an event, found something else: {error}") from error


def lacking(data: bytes) -> list[Shape]:
    """Return which arrays a message lacks: none, or all.

    Raises:
        WireError: It is no message of ours.
    """
    shapes, begin, end = _shapes(data)
    content = any(0 not in shape for _, shape, _ in shapes)
    if not shapes or len(data) - _HEAD.size > end or (not content and begin == end):
        return []
    return [Shape(dtype, tuple(shape)) for dtype, shape, _ in shapes]


def fields(data: bytes) -> dict[str, Any]:
    """Return the fields of a message's event as msgpack has them; arrays are numbers.

    Raises:
        WireError: It is no message of ours.
    """
    try:
        (length,) = _LENGTH.unpack_from(data, _HEAD.size)
        begin = _HEAD.size + _LENGTH.size
        _, _, found = _decode(memoryview(data)[begin : begin + length])
        decoded: dict[str, Any] = msgspec.msgpack.decode(found)
    except (struct.error, msgspec.DecodeError) as error:
        raise WireError(f"expected an event, found something else: {error}") from error
    return decoded


def event(data: bytes, arrays: Sequence[npt.NDArray[Any]] = ()) -> Event:
    """Return the event of a message.

    Args:
        data: The message.
        arrays: Those that it lacks.

    Raises:
        WireError: The two do not fit, or the type of event is not known here.
    """
    if not arrays:
        return unpack(memoryview(data)[_HEAD.size :])
    shapes, begin, end = _shapes(data)
    if [(np.dtype(d), tuple(s)) for d, s, _ in shapes] != [(a.dtype, a.shape) for a in arrays]:
        found = ", ".join(f"{a.dtype}{list(a.shape)}" for a in arrays)
        raise WireError(f"expected arrays of {[(d, s) for d, s, _ in shapes]}, found {found}")
    size = begin + max(at + a.nbytes for (_, _, at), a in zip(shapes, arrays, strict=True))
    frame = np.empty(size, np.uint8)
    frame[:end] = np.frombuffer(data, np.uint8, end, _HEAD.size)
    for (_, _, at), array in zip(shapes, arrays, strict=True):
        place = frame[begin + at : begin + at + array.nbytes]
        place[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return unpack(frame.data)


class _Source(msgspec.Struct):
    source: str


_source = msgspec.msgpack.Decoder(_Source).decode


def _shapes(data: bytes) -> tuple[list[tuple[str, list[int], int]], int, int]:
    """Return the arrays of a frame, where they begin in it, and where its head ends."""
    try:
        (length,) = _LENGTH.unpack_from(data, _HEAD.size)
        end = _LENGTH.size + length
        _, shapes, _ = _decode(memoryview(data)[_HEAD.size + _LENGTH.size : _HEAD.size + end])
    except (struct.error, msgspec.DecodeError) as error:
        raise WireError(f"expected an event, found something else: {error}") from error
    return shapes, -(-end // ALIGNED) * ALIGNED, end


Array = npt.NDArray[Any]

HOLDERS = {
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/PointCloud2",
}
"""Types of messages that have an event's arrays."""


def arrays(
    store: TypeStore, data: bytes, type_: str, shapes: list[Shape], axes: Axes
) -> list[Array]:
    """Return an event's arrays.

    Args:
        store: Of the types.
        data: A message.
        type_: Of the message.
        shapes: Of the arrays.
        axes: Of the event's frame, for clouds.

    Raises:
        ValueError: The message has no such arrays.
    """
    message = store.deserialize(data, type_)
    try:
        if type_.endswith("PointCloud2"):
            return _cloud(message, shapes, axes)
        (shape,) = shapes
        if type_ == COMPRESSED:
            found = decode_compressed(message)
        else:
            found = np.frombuffer(message.data, np.dtype(shape.dtype)).reshape(shape.shape)
    except (ValueError, cv2.error) as error:
        raise ValueError(f"expected arrays of {shapes}, found others: {error}") from error
    return [found]


def _cloud(message: Any, shapes: list[Shape], axes: Axes) -> list[Array]:
    """Return the arrays of a cloud, or of a lidar's turn, in the order of the event's fields.

    A cloud's colours are there if there is room for them: all are white where there were none.
    """
    scan = message.point_step == LIDAR_POINT.itemsize
    rows = np.frombuffer(message.data, LIDAR_POINT if scan else POINT, shapes[0].shape[0])
    points = convert_points(axes, np.ascontiguousarray(rows["xyz"]))
    if scan:
        return [points, *(np.ascontiguousarray(rows[n]) for n in ("intensity", "time", "ring"))]
    counts = [colors.shape[0] for colors in shapes[1:]]
    return [points, *(np.ascontiguousarray(rows["bgr"][:count, ::-1]) for count in counts)]
