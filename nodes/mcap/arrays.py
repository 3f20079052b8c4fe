"""The arrays that an event lacks in a recording, from ROS's message that has them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events.frames import Axes, convert_points
from nodes.mcap.native import Shape
from nodes.ros_messages.depth import COMPRESSED, DEPTH_HEAD
from nodes.ros_messages.typestore import TypeStore

Array = npt.NDArray[Any]

HOLDERS = {
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/PointCloud2",
}
"""Types of messages that have an event's arrays."""

_POINT = np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("_", "u1")])
"""As `ros_messages.images` writes them."""


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
            found = decoded(message)
        else:
            found = np.frombuffer(message.data, np.dtype(shape.dtype)).reshape(shape.shape)
    except (ValueError, cv2.error) as error:
        raise ValueError(f"expected arrays of {shapes}, found others: {error}") from error
    return [found]


def _cloud(message: Any, shapes: list[Shape], axes: Axes) -> list[Array]:
    """Return points, and colours if there is room for them: all are white where there were none."""
    rows = np.frombuffer(message.data, _POINT, shapes[0].shape[0])
    points = convert_points(axes, np.ascontiguousarray(rows["xyz"]))
    counts = [colors.shape[0] for colors in shapes[1:]]
    return [points, *(np.ascontiguousarray(rows["bgr"][:count, ::-1]) for count in counts)]


def decoded(message: Any) -> Array:
    """Return the pixels of a CompressedImage: RGB, grey, or depth in metres.

    Raises:
        ValueError: It is no picture, or depth in a form that is not known.
    """
    code: Array = message.data
    if "compressedDepth" in message.format:
        return _decoded_depth(code, message.format)
    pixels = _pixels(code)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels


def _decoded_depth(code: Array, form: str) -> Array:
    """Return metres from what compressed_depth_image_transport makes (its codec.cpp).

    16UC1: millimetres. 32FC1: inverse depth, ``a / z + b``, with a and b before the PNG.
    """
    if len(code) <= DEPTH_HEAD.size:
        raise ValueError("expected a picture, found no more than the head of one")
    _, a, b = DEPTH_HEAD.unpack(code[: DEPTH_HEAD.size].tobytes())
    steps = _pixels(code[DEPTH_HEAD.size :])
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise ValueError(f"expected depth in 16 bits, found {steps.dtype} {steps.shape}")
    metres = np.full(steps.shape, np.inf, np.float32)
    there = steps > 0
    if form.startswith("16UC1"):
        metres[there] = steps[there] * np.float32(0.001)
    elif form.startswith("32FC1"):
        metres[there] = np.float32(a) / (steps[there] - np.float32(b))
    else:
        raise ValueError(f"expected depth of 16UC1 or 32FC1, found {form!r:.80}")
    return metres


def _pixels(code: Array) -> Array:
    pixels = cv2.imdecode(code, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("not a picture")
    return pixels
