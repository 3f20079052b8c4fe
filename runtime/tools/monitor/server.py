"""The server of a run's monitor: a Unix socket, served by a thread of its own.

The run's loop does nothing but make a snapshot or carry a command out, when the thread asks it to;
the thread encodes and sends, and keeps the rhythm, because time on the run's loop may be simulated.
Images are made small JPEGs in another thread, and only when a page asks.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from events import Image
from runtime.errors import CommandError, VisnavError
from runtime.tools.monitor.client import socket_of
from runtime.tools.monitor.observer import Observer, describe
from runtime.tools.monitor.protocol import (
    LONGEST_COMMAND,
    UNREADABLE,
    Answer,
    CommandRequest,
    EncodedImage,
    ImageRequest,
    Set,
    WatchRequest,
    decode_from_client,
    encode,
)

R = TypeVar("R")

log = logging.getLogger("visnav.runtime")

PERIOD = 0.2
"""Real seconds between two snapshots."""

CLOSING_TIMEOUT = 1.0
"""Real seconds for clients to receive the last snapshot."""

_LISTEN_TIMEOUT = 5.0
"""Real seconds for the socket to become ready."""

MAX_BACKLOG = 1 << 20
"""Bytes queued for a client at most; a slower client misses snapshots."""


MAX_SIDE = 480
"""Pixels of an encoded image's longer side at most."""

IMAGE_PERIOD = 0.25
"""Real seconds between two encoded images of a camera at least, however many pages ask."""

QUALITY = 75
"""Quality of the JPEG, of 100."""


class ImageEncoder:
    """Image encoder beside the run's loop, at most once per camera and `IMAGE_PERIOD`."""

    def __init__(self) -> None:
        self._encoded: dict[str, tuple[float, bytes]] = {}
        self._lock = asyncio.Lock()

    async def encode(self, camera: str, newest: Callable[[], Awaitable[Image]]) -> bytes:
        """Return the JPEG of a camera's newest image.

        Args:
            newest: Gets its newest image; not called if the last JPEG is young enough.
        """
        async with self._lock:
            now = time.monotonic()
            made, jpeg = self._encoded.get(camera, (-np.inf, b""))
            if now - made >= IMAGE_PERIOD:
                image = await newest()
                jpeg = await asyncio.to_thread(small_jpeg, image.data)
                self._encoded[camera] = now, jpeg
            return jpeg


def small_jpeg(data: npt.NDArray[np.uint8]) -> bytes:
    """Return an image as JPEG, made smaller where a side is longer than `MAX_SIDE` pixels.

    Args:
        data: Pixels, shape (height, width, 3) in RGB, or (height, width) in grey.
    """
    import cv2  # not before somebody asks for an image

    pixels: Any = data
    height, width = data.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale < 1.0:
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if data.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


class Server:
    """Server for the clients of a run's monitor.

    Args:
        observer: Makes snapshots of the run, and carries commands out.
        loop: The run's loop, on which the observer is called.
    """

    def __init__(self, observer: Observer, loop: asyncio.AbstractEventLoop, path: Path) -> None:
        self._observer = observer
        self._run_loop = loop
        self._path = path
        self._watching: set[asyncio.StreamWriter] = set()
        self._clients: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        self._ready = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end = asyncio.Event()
        self._last = b""
        self._encoder = ImageEncoder()
        self._thread = threading.Thread(target=self._run, name="monitor", daemon=True)

    def start(self) -> bool:
        """Start to listen; tell whether the socket is ready."""
        self._thread.start()
        return self._ready.wait(_LISTEN_TIMEOUT) and self._thread.is_alive()

    def stop(self) -> None:
        """Send the last snapshot to all clients, and stop listening; called on the run's loop."""
        try:
            if self._watching:
                self._last = encode(self._observer.take()) + b"\n"
            self._observer.end()
        except Exception:  # a monitor must not spoil a run's end
            log.exception("the monitor failed")
        with contextlib.suppress(RuntimeError):  # its loop is closed: it could not listen
            if self._loop is not None:
                self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(5.0)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except OSError as error:
            log.warning(
                "no monitor can connect to this run: no socket at %s: %s", self._path, error
            )
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        listener = self._listener()
        server = await asyncio.start_unix_server(self._accept, sock=listener, limit=LONGEST_COMMAND)
        self._ready.set()
        publishing = asyncio.create_task(self._publish())
        await self._end.wait()
        publishing.cancel()
        server.close()
        for writer in self._watching:
            writer.write(self._last)
        writers = list(self._clients.values())
        for task, writer in self._clients.items():
            task.cancel()
            writer.close()
        closing = asyncio.gather(*(w.wait_closed() for w in writers), return_exceptions=True)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closing, CLOSING_TIMEOUT)  # what was written still goes out
        for writer in writers:
            writer.transport.abort()
        await asyncio.sleep(0)  # they let go of their sockets
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _listener(self) -> socket.socket:
        """Return a listening socket, at its final path only once listening.

        Before, others would take it for the socket of a killed run, and remove it.
        """
        listener = socket.socket(socket.AF_UNIX)
        new = self._path.with_suffix(".new")
        new.unlink(missing_ok=True)
        listener.bind(str(new))
        new.chmod(0o600)
        listener.listen(100)
        new.rename(self._path)
        return listener

    async def _publish(self) -> None:
        """Measure and send snapshots while somebody watches."""
        measuring = failed = False
        while True:
            await asyncio.sleep(PERIOD)
            try:
                if measuring != bool(self._watching):
                    measuring = not measuring
                    change = self._observer.begin if measuring else self._observer.end
                    await self._on_run_loop(change)
                elif measuring:
                    line = encode(await self._on_run_loop(self._observer.take)) + b"\n"
                    for writer in self._watching:
                        if writer.transport.get_write_buffer_size() < MAX_BACKLOG:
                            writer.write(line)
            except Exception:
                if not failed:
                    log.exception("the monitor failed")
                failed = True

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._end.is_set():
            writer.transport.abort()
            return
        task = asyncio.create_task(self._serve_client(reader, writer))
        self._clients[task] = writer  # not in the task, which may be cancelled before it begins
        task.add_done_callback(self._clients.pop)

    async def _serve_client(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            async for line in reader:
                await self._handle_line(line, writer)
                await writer.drain()  # a client that reads no answers has to wait
        except (OSError, ValueError):  # gone, or a line without an end
            pass
        except asyncio.CancelledError:  # the run is over
            pass
        finally:
            self._watching.discard(writer)
            writer.close()

    async def _handle_line(self, line: bytes, writer: asyncio.StreamWriter) -> None:
        try:
            message = decode_from_client(line)
        except UNREADABLE as error:
            answer = Answer(number=-1, done=False, text=f"expected a command: {error}")
            writer.write(encode(answer) + b"\n")
            return
        match message:
            case WatchRequest():
                self._watching.add(writer)
            case CommandRequest() | ImageRequest():
                writer.write(encode(await self._answer(message)) + b"\n")

    async def _answer(self, request: CommandRequest | ImageRequest) -> Answer | EncodedImage:
        try:
            if isinstance(request, ImageRequest):
                return await self._image(request)
            text = await self._on_run_loop(lambda: self._observer.execute(request.command))
        except VisnavError as error:
            return Answer(number=request.number, done=False, text=str(error))
        except Exception:
            log.exception("the monitor failed")
            text = "the run could not do it, and its log says why"
            return Answer(number=request.number, done=False, text=text)
        if not isinstance(request.command, Set):  # which logs it itself
            log.info("asked by hand: %s", describe(request.command))
        return Answer(number=request.number, done=True, text=text)

    async def _image(self, request: ImageRequest) -> EncodedImage:
        jpeg = await self._encoder.encode(
            request.camera,
            lambda: self._on_run_loop(lambda: self._observer.image(request.camera)),
        )
        return EncodedImage(number=request.number, jpeg=jpeg)

    async def _on_run_loop(self, call: Callable[[], R]) -> R:
        """Have a function called on the run's loop, and return its result."""
        done: concurrent.futures.Future[R] = concurrent.futures.Future()

        def do() -> None:
            if not done.set_running_or_notify_cancel():
                return
            try:
                done.set_result(call())
            except Exception as error:
                done.set_exception(error)

        self._run_loop.call_soon_threadsafe(do)
        return await asyncio.wrap_future(done)


@contextlib.contextmanager
def serving(observer: Observer, run: str) -> Iterator[Path | None]:
    """Let a run be watched and controlled while the block lasts; called on its loop.

    Yields:
        The socket's path; `None` if there can be none.
    """
    try:
        path = socket_of(run)
    except (CommandError, OSError) as error:
        log.warning("no monitor can connect to this run: %s", error)
        yield None
        return
    server = Server(observer, asyncio.get_running_loop(), path)
    try:
        yield path if server.start() else None
    finally:
        server.stop()
