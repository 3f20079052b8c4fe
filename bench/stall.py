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
import functools
import itertools
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from bench.benchmarks import Progress, Row
from bench.harness import lines_of, paired, program, silent
from bench.lateness import BEATS, figures, hover
from events import Odometry
from runtime import Input, Node, NodeConfig, Tick, Worker, every
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.renderer import Shot
from sims.worlds import load_world

Mode = Literal["none", "inline", "thread", "worker", "fetch inline", "fetch"]
DELAY = 0.08  # response time of the server, seconds
WARM_UP = 1_000_000_000  # nanoseconds left out at the start of each run
MODES: tuple[Mode, ...] = get_args(Mode)

FETCHES: list[int] = []  # times of this process's camera, ns; the measuring code clears the list


class CameraConfig(NodeConfig):
    """Settings of the camera under test."""

    mode: Mode
    size: int = 512
    rate: float = 10.0
    port: int = 0


class Camera(Node[CameraConfig]):
    """Node to fetch RGB-D pairs of the vehicle's view, in the mode under test."""

    odometry = Input(Odometry, keep="latest")

    async def on_startup(self) -> None:
        """Start the renderer, or connect to the server, as the mode requires."""
        mode = self.config.mode
        self._at_end = contextlib.AsyncExitStack()
        self._fetch: Callable[[tuple[Shot, ...]], Any] | None = None
        if mode in {"fetch", "fetch inline"}:
            await self._connect()
        elif mode != "none":
            await self._render()

    async def _render(self) -> None:
        config = self.config
        spec = CameraSpec(name="eye", width=config.size, height=config.size)
        arguments = (await self.offload(_model, spec), (spec,), "free/", 0)
        if config.mode == "worker":
            worker: Worker[CameraRenderer] = await self.worker(CameraRenderer, *arguments)
            self._fetch = lambda shots: worker.call(CameraRenderer.expose, shots)
            return
        # An OpenGL context belongs to one thread: the pool's, or the loop's for `inline`.
        pool = concurrent.futures.ThreadPoolExecutor(1)

        async def call(function: Callable[..., Any], *arguments: Any) -> Any:
            if config.mode == "inline":
                return function(*arguments)
            return await self.clock.beside(pool.submit(function, *arguments))

        renderer = await call(CameraRenderer, *arguments)
        self._fetch = functools.partial(call, renderer.expose)
        self._at_end.callback(pool.shutdown)
        self._at_end.push_async_callback(call, renderer.close)

    async def _connect(self) -> None:
        address = ("127.0.0.1", self.config.port)
        size = pair_size(self.config.size)
        if self.config.mode == "fetch":
            reader, writer = await asyncio.open_connection(*address, limit=size)
            self._at_end.push_async_callback(writer.wait_closed)
            self._at_end.callback(writer.close)

            async def fetch(_: Any) -> None:
                writer.write(b"?")
                await reader.readexactly(size)
        else:
            link = self._at_end.enter_context(socket.create_connection(address))
            pair = memoryview(bytearray(size))

            async def fetch(_: Any) -> None:
                link.sendall(b"?")
                got = 0
                while got < size:
                    got += link.recv_into(pair[got:])

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
            FETCHES.append(time.monotonic_ns() - asked)

    async def on_shutdown(self) -> None:
        """Close the renderer, in its own thread for mode ``thread``, or the connection."""
        await self._at_end.aclose()


def pair_size(side: int) -> int:
    """Return the bytes of a square colour image with its depth."""
    return side * side * (3 + 4)


def _model(camera: CameraSpec) -> bytes:
    spec = load_world("hall")
    add_free_camera(spec, "free", (camera,))
    return model_to_bytes(spec.compile())


class Run(NamedTuple):
    """Run of a mode: lateness, times between ticks and fetches (ns), and count of missed ticks."""

    late: list[int]
    update: list[int]
    fetch: list[int]
    missed: int


def measure(
    *,
    seconds: float,
    repeats: int,
    rate: float = 10.0,
    size: int = 512,
    progress: Progress = silent,
) -> list[Row]:
    """Measure all modes.

    Args:
        seconds: Of each run, after a second of warm-up.
    """
    with program("-m", "bench.stall", DELAY, pair_size(size)) as server:
        port = int(next(lines_of(server)))
        settings = {"rate": rate, "size": size, "port": port}
        camera = {"name": "camera", "type": f"{__name__}:Camera", **settings}
        sides = {mode: functools.partial(_run, seconds, camera | {"mode": mode}) for mode in MODES}
        measured = paired(sides, repeats, progress)
    return [_row(mode, runs, measured["none"]) for mode, runs in measured.items()]


def _run(seconds: float, camera: dict[str, Any]) -> Run:
    FETCHES.clear()
    hover("stall", seconds + 1.0, camera)
    ticks = [(old, new) for old, new in itertools.pairwise(BEATS) if new.stamp > WARM_UP]
    return Run(
        late=[new.late for _, new in ticks],
        update=[new.at - old.at for old, new in ticks],
        fetch=[*FETCHES],
        missed=sum(new.missed for _, new in ticks),
    )


def _row(mode: str, runs: Sequence[Run], without: Sequence[Run]) -> Row:
    """Return the figures of a mode beside those of no camera.

    ``missed`` is of ticks left out because an earlier one came too late, ``fetch_ms_median`` from
    asking for a pair to having it; 0 without any.
    """
    late, beside = (np.concatenate([run.late for run in side]) for side in (runs, without))
    update = np.concatenate([run.update for run in runs]) / 1e6
    fetch = np.concatenate([run.fetch for run in runs]) / 1e6
    return {
        **figures([late], [beside]),
        "mode": mode,
        "missed": sum(run.missed for run in runs),
        "update_mean_ms": float(update.mean()),
        "update_median_ms": float(np.median(update)),
        "update_sd_ms": float(update.std()),
        "frames": len(fetch),
        "fetch_ms_median": float(np.median(fetch)) if len(fetch) else 0.0,
    }


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


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
