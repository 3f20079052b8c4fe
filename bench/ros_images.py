"""What an image costs on its way to ROS 2: encoded as the bridge does it, and by rosbags alone.

Both make the same bytes: CDR of a ``sensor_msgs/msg/Image``. Rosbags gets its message ready-made
and has only to be told the time. Samples are taken in turns, in an order that is drawn each time,
so that whatever else the machine does falls on both alike; a ratio is that of the two medians.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

from nodes.ros2.messages.images import ImageWriter
from nodes.ros2.messages.typestore import TypeStore

IMAGE = "sensor_msgs/msg/Image"
FRAME = "camera_optical_frame"
WARM_UP = 20


class RosImageRow(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of image.

    Attributes:
        case: Size and encoding.
        bytes: Of a message.
        samples: Of each side.
        ours_us: Median microseconds that the bridge takes to encode one.
        rosbags_us: The same of rosbags' ``serialize_cdr``.
        ratio: Ours to theirs.
        ours_p99_us: 99th percentile of ours.
        rosbags_p99_us: Of theirs.
    """

    case: str
    bytes: int
    samples: int
    ours_us: float
    rosbags_us: float
    ratio: float
    ours_p99_us: float
    rosbags_p99_us: float


def measure(repeats: int = 300) -> list[RosImageRow]:
    """Measure a colour image and a depth image of 512×512."""
    drawn = np.random.default_rng(0)
    return [
        _measure("rgb8", drawn.integers(0, 256, (512, 512, 3), np.uint8), repeats),
        _measure("32FC1", drawn.uniform(0.3, 20.0, (512, 512)).astype(np.float32), repeats),
    ]


def _measure(encoding: str, data: npt.NDArray[Any], repeats: int) -> RosImageRow:
    ours, theirs = _by_the_bridge(encoding, data), _by_rosbags(encoding, data)
    for number in range(WARM_UP):
        if bytes(ours(number)) != bytes(theirs(number)):
            raise AssertionError(f"{encoding}: expected the same bytes of both")
    taken: dict[Callable[[int], Any], list[int]] = {ours: [], theirs: []}
    shuffle = random.Random(0).shuffle
    order = [ours, theirs]
    for number in range(repeats):
        shuffle(order)
        for encode in order:
            begin = time.perf_counter_ns()
            encode(number)
            taken[encode].append(time.perf_counter_ns() - begin)
    median, p99 = (
        [float(np.percentile(taken[each], q)) / 1e3 for each in (ours, theirs)] for q in (50, 99)
    )
    height, width = data.shape[:2]
    return RosImageRow(
        case=f"{width}×{height} {encoding}",
        bytes=len(ours(0)),
        samples=repeats,
        ours_us=median[0],
        rosbags_us=median[1],
        ratio=median[0] / median[1],
        ours_p99_us=p99[0],
        rosbags_p99_us=p99[1],
    )


def _by_the_bridge(encoding: str, data: npt.NDArray[Any]) -> Callable[[int], Any]:
    writer = ImageWriter(TypeStore(), FRAME, encoding)
    return lambda number: writer.write((number, 7), data)


def _by_rosbags(encoding: str, data: npt.NDArray[Any]) -> Callable[[int], Any]:
    store, plain = TypeStore(), get_typestore(Stores.ROS2_JAZZY)
    message: Any = plain.types[IMAGE](
        header=store.header((0, 7), FRAME),
        height=data.shape[0],
        width=data.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=data.nbytes // data.shape[0],
        data=data.view(np.uint8).ravel(),
    )

    def encode(number: int) -> Any:
        message.header.stamp.sec = number
        return plain.serialize_cdr(message, IMAGE)

    return encode
