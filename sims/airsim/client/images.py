"""Images of a server: requested and made into arrays in a process of their own.

A float image comes as a list of numbers, which takes milliseconds to decode, of the loop's too if
that were done in a thread.
"""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from sims.airsim import wire
from sims.airsim.structures import ImageRequest, ImageResponse, Pose

_TYPES = {"rgb": 0, "depth": 1, "segmentation": 7}
"""AirSim's types of images: the grey level of "infrared" is an object's ID."""
_CHANNELS = {"rgb": (3, 4), "depth": (1,), "segmentation": (3, 4)}
_SKY = 65504.0
"""Metres from which on a depth is none: the greatest half float, which AirSim sends."""


Wanted = tuple[str, str]
"""A camera, and a kind of image."""


class ImageSet(NamedTuple):
    """Images of one instant.

    Attributes:
        stamp: The server's, of the first response (ns).
        images: By camera and kind, arrays as the events hold them.
        poses: Of each camera in the vehicle's local NED, x forward, y right, z down.
        resampled: Cameras whose depth had another size than their image.
    """

    stamp: int
    images: dict[Wanted, npt.NDArray[Any]]
    poses: dict[str, Pose]
    resampled: list[str]


def decode(responses: Any, wanted: Sequence[Wanted], bgr: bool) -> ImageSet:
    """Make arrays of the responses to a request.

    Args:
        responses: The result of ``simGetImages``.
        wanted: What was asked for, in this order.
        bgr: Whether colours come as blue, green, red (AirSim's) and not as red, green, blue.

    Raises:
        ValueError: They are not what was asked for.
    """
    found = msgspec.convert(responses, list[ImageResponse])
    if len(found) != len(wanted) or not found:
        raise ValueError(f"expected {len(wanted)} images, found {len(found)}")
    result = ImageSet(found[0].time_stamp, {}, {}, [])
    for (camera, kind), response in zip(wanted, found, strict=True):
        rows, columns = response.height, response.width
        data: Any = response.image_data_float if kind == "depth" else response.image_data_uint8
        channels = len(data) // max(rows * columns, 1)
        if channels not in _CHANNELS[kind] or len(data) != rows * columns * channels:
            raise ValueError(
                f"{camera}: {kind}: expected {columns}x{rows} pixels, found {len(data)} numbers "
                f"{response.message}"
            )
        if kind == "depth":
            array: npt.NDArray[Any] = np.array(data, np.float32).reshape(rows, columns)
            array[~(array < _SKY)] = np.inf
        else:
            array = np.frombuffer(data, np.uint8).reshape(rows, columns, channels)
            if kind == "rgb":
                array = np.ascontiguousarray(array[..., 2::-1] if bgr else array[..., :3])
            else:
                array = array[..., 0].astype(np.int32)
        result.images[camera, kind] = array
        pose = Pose(response.camera_position, response.camera_orientation)
        result.poses.setdefault(camera, pose)
    for (camera, kind), array in result.images.items():
        size = result.images.get((camera, "rgb"), array).shape[:2]
        if array.shape[:2] != size:  # to that of the colours, each pixel that of the nearest centre
            at = [((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(size, array.shape)]  # noqa: B905
            result.images[camera, kind] = array[np.ix_(*at)]
            result.resampled.append(camera)
    return result


def requests(wanted: Sequence[Wanted], vehicle: str, cosys: bool) -> tuple[Any, ...]:
    """Return the arguments of ``simGetImages`` for images of one instant."""
    asked = [ImageRequest(name, _TYPES[kind], kind == "depth", False) for name, kind in wanted]
    return (asked, vehicle) if cosys else (asked, vehicle, False)


class ImageSource:
    """A connection that only asks for images; made in a process of its own.

    Args:
        address: The server's host and port.
        vehicle: Its name on the server.
        cosys: Whether the server is one of Cosys-AirSim's.
        wanted: What is asked for, in one request.
        limit: Seconds after which a request is given up, and its connection closed.
    """

    def __init__(
        self,
        address: tuple[str, int],
        vehicle: str,
        cosys: bool,
        wanted: Sequence[Wanted],
        limit: float,
    ) -> None:
        self._address, self._bgr, self._limit = address, not cosys, limit
        self._wanted, self._arguments = wanted, requests(wanted, vehicle, cosys)
        self._ids = itertools.count()
        self._socket: socket.socket | None = None

    def fetch(self) -> ImageSet | str:
        """Return a set of images, or why there is none; the next call connects anew if need be."""
        try:
            return decode(self._call(), self._wanted, self._bgr)
        except (OSError, wire.WireFormatError) as error:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
            return f"{type(error).__name__}: {error}"
        except (ValueError, OverflowError) as error:
            return str(error)

    def _call(self) -> Any:
        until = time.monotonic() + self._limit
        if self._socket is None:
            self._socket = socket.create_connection(self._address, self._limit)
            self._decoder = wire.Decoder(wire.LONGEST_REPLY)
        id_ = next(self._ids)
        self._socket.sendall(wire.request(id_, "simGetImages", self._arguments))
        while (rest := until - time.monotonic()) > 0.0:
            self._socket.settimeout(rest)
            if not (data := self._socket.recv(1 << 20)):
                raise ConnectionResetError("the server closed the connection")
            for message in self._decoder.feed(data):
                if isinstance(message, wire.Reply) and message.id == id_:
                    if message.error is not None:
                        raise ValueError(str(message.error))
                    return message.result
        raise TimeoutError(f"no images in {self._limit:g} s")
