"""Connections to an AirSim server: calls on the run's loop, images beside the loop."""

from __future__ import annotations

import asyncio
import itertools
import socket
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np
import numpy.typing as npt

from runtime import Node
from visnav_airsim import wire
from visnav_airsim.wire import ImageRequest, ImageResponse, Pose

_AGAIN = 0.1  # real seconds between two attempts to connect
_SKY = 65504.0  # metres from which on a depth is none: the greatest half float, which AirSim sends
# Types of images (the grey level of "infrared" is an object's ID), and their channels.
_TYPES = {"rgb": 0, "depth": 1, "segmentation": 7}
_CHANNELS = {"rgb": (3, 4), "depth": (1,), "segmentation": (3, 4)}

Wanted = tuple[str, str]  # a camera, and a kind of image


class RpcCallError(Exception):
    """The server's answer to a call is an error; the text is the server's."""


class RpcClient(asyncio.Protocol):
    """Connection with overlapping calls: replies are matched to calls by number."""

    def __init__(self) -> None:
        self._decoder = wire.Decoder(wire.LONGEST_REPLY)
        self._ids = itertools.count()
        self._calls: dict[int, asyncio.Future[Any]] = {}
        self._lost: Exception | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is of another class

    def connection_lost(self, exc: Exception | None) -> None:
        """Fail all pending calls."""
        self._lost = exc or ConnectionResetError("the server closed the connection")
        calls, self._calls = self._calls, {}
        for call in calls.values():
            if not call.done():
                call.set_exception(self._lost)

    def data_received(self, data: bytes) -> None:
        """Set the results of the calls that these replies answer."""
        try:
            for message in self._decoder.feed(data):
                if isinstance(message, wire.Reply):
                    self._settle(message)
        except wire.WireFormatError:
            self._transport.abort()

    def send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a call at once, and return its result's future; `OSError` without connection."""
        if self._lost is not None:
            raise self._lost
        id_ = next(self._ids) % (1 << 30)
        call = self._calls[id_] = asyncio.get_running_loop().create_future()
        self._transport.write(wire.request(id_, method, arguments))
        return call

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

    def _settle(self, reply: wire.Reply) -> None:
        call = self._calls.pop(reply.id, None)
        if call is None or call.done():
            return
        if reply.error is not None:
            call.set_exception(RpcCallError(str(reply.error)))
        else:
            call.set_result(reply.result)


class Connection:
    """Reconnectable connection whose calls have real time limits on either clock.

    In lockstep, simulated time waits for each reply, so that it comes at one simulated time in
    every run. An `OSError`, which a `TimeoutError` is, always means that the connection is gone.

    Args:
        limit: Real seconds that a reply may take.
    """

    def __init__(self, node: Node[Any], address: tuple[str, int], limit: float) -> None:
        self._node, self._address, self._limit = node, address, limit
        self._client: RpcClient | None = None

    async def connect(self, seconds: float) -> None:
        """Connect, trying again, and wait for a first reply; `OSError` after real seconds."""
        offload, until = self._node.offload, time.monotonic() + seconds
        while True:
            self.close()
            remaining = max(until - time.monotonic(), _AGAIN)
            try:
                opened = await offload(socket.create_connection, self._address, remaining)
                loop = asyncio.get_running_loop()
                _, self._client = await loop.create_connection(RpcClient, sock=opened)
                await self.call("ping", limit=remaining)
                return
            except OSError:
                if time.monotonic() > until:
                    raise
            await offload(time.sleep, _AGAIN)

    def send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a call, and return its result's future; `OSError` if the connection is lost."""
        if self._client is None:
            raise ConnectionResetError("not connected")
        future = self._client.send(method, *arguments)
        future.add_done_callback(asyncio.Future.exception)  # marks the exception as retrieved
        return future

    async def call(self, method: str, *arguments: Any, limit: float | None = None) -> Any:
        """Call a method and return its result.

        Raises:
            RpcCallError: The server refused it.
            OSError: The connection is lost, or no reply has come in time.
        """
        future, limit = self.send(method, *arguments), self._limit if limit is None else limit
        if self._node.clock.kind == "real":
            await asyncio.wait([future], timeout=limit)
        else:  # the loop reads sockets while simulated time waits for a thread
            over = threading.Event()
            future.add_done_callback(lambda _: over.set())
            await self._node.offload(over.wait, limit)
        if not future.done():
            self.close()
            raise TimeoutError(f"{method}: no reply in {limit:g} s")
        return future.result()

    async def settle(self) -> None:
        """In lockstep, wait until all calls before have started, and for replies due by now."""
        if self._node.clock.kind == "lockstep":
            await self.call("ping")

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None


class ImageSet(NamedTuple):
    """Images of a single instant."""

    stamp: int  # the server's, of the first response (ns)
    images: dict[Wanted, npt.NDArray[Any]]  # by camera and kind, arrays as the events hold them
    poses: dict[str, Pose]  # of each camera in the vehicle's local NED, x forward, y right, z down
    resampled: list[str]  # cameras whose depth had another size than their image


def requests(wanted: Sequence[Wanted], vehicle: str, cosys: bool) -> tuple[Any, ...]:
    """Return the arguments of ``simGetImages`` for images of a single instant."""
    image_requests = [
        ImageRequest(name, _TYPES[kind], kind == "depth", False) for name, kind in wanted
    ]
    return (image_requests, vehicle) if cosys else (image_requests, vehicle, False)


def decode(responses: Any, wanted: Sequence[Wanted], bgr: bool) -> ImageSet:
    """Make arrays of the responses to a request.

    Args:
        wanted: What was asked for, in this order.
        bgr: Whether colours come as blue, green, red (AirSim's) and not as red, green, blue.

    Raises:
        ValueError: They are not what was asked for.
    """
    decoded = msgspec.convert(responses, list[ImageResponse])
    if len(decoded) != len(wanted) or not decoded:
        raise ValueError(f"expected {len(wanted)} images, found {len(decoded)}")
    result = ImageSet(decoded[0].time_stamp, {}, {}, [])
    for (camera, kind), response in zip(wanted, decoded, strict=True):
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


class ImageSource:
    """Connection for images only; made in a process of its own.

    A float image comes as a list of numbers, which takes milliseconds to decode, of the loop's too
    if that were done in a thread.
    """

    def __init__(
        self,
        address: tuple[str, int],
        vehicle: str,
        cosys: bool,  # whether the server is one of Cosys-AirSim's
        wanted: Sequence[Wanted],  # images of each request
        limit: float,  # seconds after which a request is given up, and its connection closed
    ) -> None:
        self._address, self._bgr, self._limit = address, not cosys, limit
        self._wanted, self._arguments = wanted, requests(wanted, vehicle, cosys)
        self._ids = itertools.count()
        self._socket: socket.socket | None = None

    def fetch(self) -> ImageSet | str:
        """Return a set of images, or why there is none; the next call reconnects if needed."""
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
        while (remaining := until - time.monotonic()) > 0.0:
            self._socket.settimeout(remaining)
            if not (data := self._socket.recv(1 << 20)):
                raise ConnectionResetError("the server closed the connection")
            for message in self._decoder.feed(data):
                if isinstance(message, wire.Reply) and message.id == id_:
                    if message.error is not None:
                        raise ValueError(str(message.error))
                    return message.result
        raise TimeoutError(f"no images in {self._limit:g} s")
