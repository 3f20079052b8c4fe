"""The arrays that an event lacks in a recording, from ROS's message that has them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events.frames import Axes, convert_points
from nodes.mcap.native import Shape
from nodes.ros_messages.depth import decode_compressed
from nodes.ros_messages.images import COMPRESSED, LIDAR_POINT, POINT
from nodes.ros_messages.typestore import TypeStore

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
