"""A small server whose answers a test scripts, on a loop of its own in a thread.

As a program (``python -m extensions.airsim.tests.client.fake WIDTH HEIGHT``) it prints its port,
and its images take 80 ms each, as those of an Unreal Engine do.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from visnav_airsim import wire
from visnav_airsim.wire import (
    CameraInfo,
    ImageResponse,
    ImuData,
    KinematicsState,
    MultirotorState,
    Pose,
    Quaternionr,
    Vector3r,
)

START = 1_700_000_000 * 10**9
"""The server's clock at its start (ns)."""
GRAVITY = Vector3r(0.0, 0.0, -9.81)


class NoReply(Exception):  # noqa: N818
    """Raised by a method that is never to answer."""


class HangUp(Exception):  # noqa: N818
    """Raised by a method that ends its connection."""


class FakeServer:
    """A vehicle that stands 1 m east of its start, and a clock that moves when it is told to.

    Attributes:
        methods: By name; a test puts others in.
        calls: All calls in order, with their arguments.
        time: Nanoseconds of its clock.
        late: Seconds that images take.
        port: Where it listens.
    """

    def __init__(self) -> None:
        self.methods: dict[str, Callable[..., Any]] = {
            "ping": lambda: True,
            "getServerVersion": lambda: 1,
            "listVehicles": lambda: ["Alpha", "Beta"],
            "getSettingsString": lambda: "",
            "simIsPaused": lambda: False,
            "simPause": lambda _: None,
            "enableApiControl": lambda *_: None,
            "armDisarm": lambda *_: True,
            "cancelLastTask": lambda _: None,
            "takeoff": lambda *_: True,
            "land": lambda *_: True,
            "hover": lambda _: True,
            "moveByVelocity": lambda *_: True,
            "simGetObjectPose": lambda *_: Pose(Vector3r(10.0, 1.0, 0.0)),
            "simGetCameraInfo": lambda *_: CameraInfo(Pose(Vector3r(0.5, 1.0, -0.25)), 60.0),
            "simContinueForTime": self.go_on,
            "getMultirotorState": self.state,
            "getImuData": lambda *_: ImuData(self.time, linear_acceleration=GRAVITY),
            "simGetCollisionInfo": lambda _: wire.CollisionInfo(),
            "simGetImages": self.images,
        }
        self.calls: list[tuple[str, list[Any]]] = []
        self.time = START
        self.velocity = Vector3r()
        self.size = 8, 4
        self.late = 0.0
        self._writers: set[asyncio.StreamWriter] = set()
        self.port = 0

    def go_on(self, seconds: float) -> None:
        self.time += round(seconds * 1e9)

    def state(self, _: str) -> MultirotorState:
        return MultirotorState(
            timestamp=self.time,
            kinematics_estimated=KinematicsState(
                position=Vector3r(0.0, 1.0, 0.0), linear_velocity=self.velocity
            ),
        )

    def images(self, requests: list[dict[str, Any]], *_: Any) -> list[ImageResponse]:
        width, height = self.size
        responses: list[ImageResponse] = []
        for request in requests:
            floats = np.arange(width * height, dtype=np.float32) + 1.0
            floats[-1] = 65504.0
            colours = np.zeros((height, width, 3), np.uint8)
            colours[..., 0], colours[..., 2] = request["image_type"] + 1, 200
            depth = request["image_type"] == 1
            responses.append(
                ImageResponse(
                    image_data_uint8=b"" if depth else colours.tobytes(),
                    image_data_float=wire.float_array(floats) if depth else (),
                    camera_position=Vector3r(0.5, 1.0, -0.25),
                    camera_orientation=Quaternionr(),
                    time_stamp=self.time + len(responses),
                    width=width,
                    height=height,
                    image_type=request["image_type"],
                )
            )
        return responses

    def made(self, method: str) -> list[list[Any]]:
        """Return the arguments of all calls of a method."""
        return [arguments for name, arguments in self.calls if name == method]

    @contextlib.contextmanager
    def serving(self) -> Iterator[FakeServer]:
        """Listen, on a port that is free the first time and the same one after that."""
        up, down = threading.Event(), asyncio.Event()

        async def serve() -> None:
            server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
            self.port = server.sockets[0].getsockname()[1]
            up.set()
            await down.wait()
            server.close()
            for writer in tuple(self._writers):
                writer.transport.abort()

        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
        thread.start()
        up.wait(10)
        try:
            yield self
        finally:
            loop.call_soon_threadsafe(down.set)
            thread.join()
            for task in asyncio.all_tasks(loop):
                task.cancel()
            loop.run_until_complete(asyncio.sleep(0))
            loop.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        decoder = wire.Decoder()
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                for message in decoder.feed(data):
                    assert isinstance(message, wire.Request)
                    self._answer(message, writer)
        self._writers.discard(writer)
        writer.close()

    def _answer(self, request: wire.Request, writer: asyncio.StreamWriter) -> None:
        self.calls.append((request.method, request.arguments))
        method = self.methods.get(request.method)
        assert request.id is not None
        try:
            if method is None:
                raise ValueError("rpclib: server could not find function")
            answer = wire.reply(request.id, None, method(*request.arguments))
        except NoReply:
            return
        except HangUp:
            writer.transport.abort()
            return
        except ValueError as error:
            answer = wire.reply(request.id, str(error), None)
        if request.method == "simGetImages" and self.late:
            asyncio.get_running_loop().call_later(self.late, writer.write, answer)
        else:
            writer.write(answer)


def main() -> None:
    """Serve in real time, with images that take 80 ms, until standard input ends."""
    server = FakeServer()
    server.size = int(sys.argv[1]), int(sys.argv[2])
    server.late = 0.08
    state, sample, images = (
        server.methods[name] for name in ("getMultirotorState", "getImuData", "simGetImages")
    )

    def now(method: Callable[..., Any]) -> Callable[..., Any]:
        def answer(*arguments: Any) -> Any:
            server.time = time.time_ns()
            return method(*arguments)

        return answer

    server.methods |= {
        "getMultirotorState": now(state),
        "getImuData": now(sample),
        "simGetImages": now(images),
    }
    with server.serving():
        print(server.port, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
