"""How late a 400 Hz controller gets while images are fetched: the thesis's table 6.3, done right.

A multirotor hovers on the real clock, controlled at 400 Hz, while a 512×512 RGB-D camera at 10 Hz
is fetched in one of these ways:

    none          not at all
    inline        rendered on the loop
    thread        rendered in a thread
    worker        rendered in a worker process, as this project does
    fetch inline  from a server on a socket that takes 80 ms, waiting for it on the loop: the thesis
    fetch         from the same server, awaited

Short runs of all ways are interleaved and pooled.

``python -m bench.stall DELAY BYTES`` is the server, a stand-in for the image fetch that the thesis
measured: it prints its port, answers each request so late, and ends with its standard input.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import itertools
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import msgspec
import numpy as np

from bench.lateness import BEATS, Beat, LateRow, figures, hover
from bench.system import in_turns
from events import Odometry
from runtime import Input, Node, NodeConfig, Tick, Worker, every
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.renderer import Shot
from sims.worlds import load_world

Mode = Literal["none", "inline", "thread", "worker", "fetch inline", "fetch"]
DELAY = 0.08  # response time of the server, seconds
WARM_UP = 1_000_000_000  # nanoseconds left out at the start of each run
MODES: tuple[Mode, ...] = ("none", "inline", "thread", "worker", "fetch inline", "fetch")


class StallRow(LateRow, frozen=True, kw_only=True):
    """Statistics of a mode of fetching images.

    Attributes:
        missed: Ticks left out because an earlier one came too late.
        frames: How many pairs of images came.
        fetch_ms_median: From asking for a pair to having it; 0 without any.
    """

    mode: str
    missed: int
    update_mean_ms: float
    update_median_ms: float
    update_sd_ms: float
    frames: int
    fetch_ms_median: float


class _Samples(msgspec.Struct):
    late: list[int] = []
    update: list[int] = []
    fetch: list[int] = []
    missed: int = 0

    def add(self, beats: list[Beat]) -> None:
        """Add a run's ticks, after a second of warm-up."""
        for before, beat in itertools.pairwise(beats):
            if beat.stamp > WARM_UP:
                self.late.append(beat.late)
                self.missed += beat.missed
                self.update.append(beat.at - before.at)


_collected: dict[str, _Samples] = {}


class CameraConfig(NodeConfig):
    """Settings of the camera under test."""

    mode: Mode
    width: int = 512
    height: int = 512
    rate: float = 10.0
    world: str = "hall"
    port: int = 0


class Camera(Node[CameraConfig]):
    """Node to fetch RGB-D pairs of the vehicle's view, in the mode under test."""

    odometry = Input(Odometry, keep="latest")

    async def on_startup(self) -> None:
        """Start the renderer, or connect to the server, as the mode requires."""
        config = self.config
        self._samples = _collected.setdefault(config.mode, _Samples())
        self._fetch: Callable[..., Any] | None = None
        if config.mode == "none":
            return
        if config.mode in {"fetch", "fetch inline"}:
            await self._connect()
            return
        spec = CameraSpec(name="eye", width=config.width, height=config.height)
        arguments = (await self.offload(_model, config.world, spec), (spec,), "free/", 0)
        if config.mode == "worker":
            worker: Worker[CameraRenderer] = await self.worker(CameraRenderer, *arguments)
            self._fetch = lambda *args: worker.call(CameraRenderer.expose, *args)
            return
        # An OpenGL context belongs to one thread: the pool's, or the loop's for `inline`.
        self._pool = concurrent.futures.ThreadPoolExecutor(1)
        if config.mode == "thread":
            renderer = await self.clock.beside(self._pool.submit(CameraRenderer, *arguments))
            self._fetch = lambda *args: self.clock.beside(self._pool.submit(renderer.expose, *args))
            self._close = renderer.close
        else:
            renderer = CameraRenderer(*arguments)

            async def render(*args: Any) -> Any:
                return renderer.expose(*args)

            self._fetch = render
            self._close = renderer.close

    async def _connect(self) -> None:
        config = self.config
        size = pair_size(config.width, config.height)
        if config.mode == "fetch":
            reader, self._writer = await asyncio.open_connection(
                "127.0.0.1", config.port, limit=size
            )

            async def fetch(*_: Any) -> None:
                self._writer.write(b"?")
                await reader.readexactly(size)
        else:
            self._socket = socket.create_connection(("127.0.0.1", config.port))
            pair = bytearray(size)

            async def fetch(*_: Any) -> None:
                self._socket.sendall(b"?")
                got = 0
                while got < size:
                    got += self._socket.recv_into(memoryview(pair)[got:])

        self._fetch = fetch

    @every(hz="rate")
    async def expose(self, tick: Tick) -> None:
        """Fetch a pair."""
        here = self.odometry.peek()
        if self._fetch is None or here is None:
            return
        asked = time.monotonic_ns()
        pose = pose_to_qpos(here.position, here.orientation)
        await self._fetch((Shot("eye", here.stamp, pose),))
        if tick.stamp > WARM_UP:
            self._samples.fetch.append(time.monotonic_ns() - asked)

    async def on_shutdown(self) -> None:
        """Close the renderer, in its own thread for mode ``thread``."""
        if self.config.mode == "thread":
            await self.clock.beside(self._pool.submit(self._close))
            self._pool.shutdown()
        elif self.config.mode == "inline":
            self._close()
        elif self.config.mode == "fetch":
            self._writer.close()
            await self._writer.wait_closed()
        elif self.config.mode == "fetch inline":
            self._socket.close()


def pair_size(width: int, height: int) -> int:
    """Return the bytes of a colour image with its depth."""
    return width * height * (3 + 4)


def _model(world: str, camera: CameraSpec) -> bytes:
    spec = load_world(world)
    add_free_camera(spec, "free", (camera,))
    return model_to_bytes(spec.compile())


def measure(
    *,
    seconds: float,
    repeats: int,
    modes: tuple[Mode, ...] = MODES,
    rate: float = 10.0,
    size: int = 512,
    progress: Callable[[str], None] = lambda _: None,
) -> list[StallRow]:
    """Measure all modes.

    Args:
        seconds: Of each run, after a second of warm-up.
    """
    _collected.clear()
    with slow_server(pair_size(size, size)) as port:
        for number, mode in in_turns(modes, repeats):
            progress(f"round {number + 1} of {repeats}: {mode}")
            settings = {"mode": mode, "rate": rate, "width": size, "height": size, "port": port}
            camera = {"name": "camera", "type": f"{__name__}:Camera", **settings}
            hover("stall", seconds + 1.0, camera)
            _collected.setdefault(mode, _Samples()).add(BEATS)
    rows = [_row(mode, _collected[mode]) for mode in modes]
    return [
        msgspec.structs.replace(row, ratio_p99=row.late_p99_us / rows[0].late_p99_us)
        for row in rows
    ]


def _row(mode: str, samples: _Samples) -> StallRow:
    update = np.array(samples.update) / 1e6
    return StallRow(
        mode=mode,
        missed=samples.missed,
        update_mean_ms=float(update.mean()),
        update_median_ms=float(np.median(update)),
        update_sd_ms=float(update.std()),
        frames=len(samples.fetch),
        fetch_ms_median=float(np.median(samples.fetch) / 1e6) if samples.fetch else 0.0,
        **figures([samples.late]),
    )


def main(delay: float, size: int) -> None:
    """Serve successive connections until standard input ends."""
    answer = bytes(size)
    server = socket.create_server(("127.0.0.1", 0))
    print(server.getsockname()[1], flush=True)
    threading.Thread(target=_serve, args=(server, delay, answer), daemon=True).start()
    sys.stdin.read()


def _serve(server: socket.socket, delay: float, answer: bytes) -> None:
    while True:
        connection, _ = server.accept()
        with connection, contextlib.suppress(OSError):
            while connection.recv(1):
                time.sleep(delay)  # the fetch that is simulated
                connection.sendall(answer)


@contextlib.contextmanager
def slow_server(size: int, delay: float = DELAY) -> Iterator[int]:
    """Run the server while the block runs, and give its port.

    An answer has `size` bytes and takes `delay` seconds.
    """
    command = [sys.executable, "-m", "bench.stall", str(delay), str(size)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline())
        finally:
            process.stdin.close()


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
