"""The server of a run's monitor: a Unix socket, and a thread for each client.

The run's loop does nothing but make a snapshot or carry a command out, when a thread asks it to;
the threads encode and send, and keep the rhythm, because time on the run's loop may be simulated.
Images are made small JPEGs there, and only when a page asks. While nobody connects, one thread
waits for somebody.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from events import TrackedFeatures
from runtime.errors import CommandError, VisnavError
from runtime.logs import RunThread
from runtime.tools.monitor import protocol
from runtime.tools.monitor.observer import Observer, describe

R = TypeVar("R")

log = logging.getLogger("visnav.runtime")

PERIOD = 0.2  # real seconds between two snapshots

IMAGE_PERIOD = 0.5
"""Real seconds between two encoded images of a camera at least, however many pages ask."""

CLOSING_TIMEOUT = 1.0  # real seconds for clients to receive the last snapshot
MAX_SIDE = 480  # pixels of an encoded image's longer side at most
QUALITY = 75  # quality of the JPEG, of 100


class ResultCache:
    """Cache of slow functions' last results, shared by all clients within a period."""

    def __init__(self) -> None:
        self._results: dict[str, tuple[float, bytes]] = {}
        self._lock = threading.Lock()

    def get(self, key: str, period: float, make: Callable[[], bytes]) -> bytes:
        """Return the last result of `make`, or a new one if that is as old as the period (s)."""
        with self._lock:
            now = time.monotonic()
            made_at, result = self._results.get(key, (-np.inf, b""))
            if now - made_at >= period:
                result = make()
                self._results[key] = now, result
            return result


class Server:
    """Server at a path for the clients of a run's monitor, on the run's `loop`; else `OSError`."""

    def __init__(self, observer: Observer, loop: asyncio.AbstractEventLoop, path: Path) -> None:
        self._observer = observer
        self._run_loop = loop
        self._path = path
        self._clients: dict[threading.Thread, socket.socket] = {}
        self._calls: set[Future[Any]] = set()
        self._watching = 0
        self._changing = threading.Lock()
        self._end = threading.Event()
        self._last = b""
        self._cache = ResultCache()
        self._failed = False
        # At its final path only once it listens: else others would remove it as a killed run's.
        self._listener = socket.socket(socket.AF_UNIX)
        new = path.with_suffix(".new")
        new.unlink(missing_ok=True)
        self._listener.bind(str(new))
        new.chmod(0o600)
        self._listener.listen(100)
        new.rename(path)
        RunThread(target=self._listen, name="monitor", daemon=True).start()

    def stop(self) -> None:
        """Send the last snapshot to all who watch, and stop listening; called on the run's loop."""
        try:
            if self._watching:
                self._last = protocol.encode(self._observer.snapshot()) + b"\n"
            self._observer.end()
        except Exception:  # a monitor must not spoil a run's end
            log.exception("the monitor failed")
        self._end.set()
        self._path.unlink(missing_ok=True)
        _shut(self._listener, socket.SHUT_RDWR)
        for call in list(self._calls):
            call.cancel()
        clients = list(self._clients.items())
        for _, client in clients:
            _shut(client, socket.SHUT_RD)  # who has not asked yet need not ask any more
        deadline = time.monotonic() + CLOSING_TIMEOUT
        for thread, client in clients:
            if thread.is_alive():  # or has not begun, and sees that this is the end
                thread.join(max(deadline - time.monotonic(), 0.0))
            _shut(client, socket.SHUT_RDWR)

    def _listen(self) -> None:
        with self._listener:
            while not self._end.is_set():
                try:
                    client, _ = self._listener.accept()
                except OSError:  # the end, or too many open files
                    self._end.wait(0.1)
                    continue
                thread = RunThread(target=self._serve, args=(client,), daemon=True)
                self._clients[thread] = client
                thread.start()

    def _serve(self, client: socket.socket) -> None:
        ends = contextlib.suppress(OSError, CancelledError)
        with client, client.makefile("rb") as lines, ends:
            while not self._end.is_set() and (line := lines.readline(protocol.LONGEST_COMMAND)):
                try:
                    request = protocol.decode_request(line)
                except protocol.UNREADABLE as error:
                    answer = protocol.Answer(done=False, text=f"expected a command: {error}")
                else:
                    if isinstance(request, protocol.Watch):
                        self._watch(client)
                        break
                    answer = self._answer(request)
                client.sendall(protocol.encode(answer) + b"\n")
        self._clients.pop(threading.current_thread(), None)

    def _watch(self, client: socket.socket) -> None:
        self._count(1)
        try:
            while not self._end.wait(PERIOD):
                try:
                    line = self._cache.get("", PERIOD / 2, self._snapshot)
                except CancelledError:
                    break
                client.sendall(line)
        finally:
            if not self._end.is_set():
                self._count(-1)
        client.sendall(self._last)

    def _count(self, change: int) -> None:
        """Count who watches: the first has the observer measure, the last one ends it."""
        with self._changing:
            self._watching += change
            if self._watching == max(change, 0):
                self._on_run_loop(self._observer.begin if change > 0 else self._observer.end)

    def _snapshot(self) -> bytes:
        try:
            return protocol.encode(self._on_run_loop(self._observer.snapshot)) + b"\n"
        except CancelledError:
            raise
        except Exception:
            if not self._failed:
                log.exception("the monitor failed")
            self._failed = True
            return b""

    def _answer(self, request: protocol.Command | protocol.Look) -> protocol.Answer:
        try:
            if isinstance(request, protocol.Look):
                jpeg = self._cache.get(
                    request.camera, IMAGE_PERIOD, lambda: self._image(request.camera)
                )
                return protocol.Answer(done=True, text=request.camera, jpeg=jpeg)
            text = self._on_run_loop(lambda: self._observer.execute(request))
        except VisnavError as error:
            return protocol.Answer(done=False, text=str(error))
        except CancelledError:
            return protocol.Answer(done=False, text="the run is over")
        except Exception:
            log.exception("the monitor failed")
            return protocol.Answer(done=False, text="the run could not do it, and its log says why")
        if not isinstance(request, protocol.Set):  # which logs it itself
            log.info("asked by hand: %s", describe(request))
        return protocol.Answer(done=True, text=text)

    def _image(self, camera: str) -> bytes:
        image, features = self._on_run_loop(lambda: self._observer.image(camera))
        return small_jpeg(image.data, features)

    def _on_run_loop(self, call: Callable[[], R]) -> R:
        done: Future[R] = Future()

        def do() -> None:
            if not done.set_running_or_notify_cancel():
                return
            try:
                done.set_result(call())
            except Exception as error:
                done.set_exception(error)

        self._calls.add(done)
        try:
            if self._end.is_set():  # or else who sets it sees the call
                raise CancelledError
            self._run_loop.call_soon_threadsafe(do)
            return done.result()
        finally:
            self._calls.discard(done)


def _shut(connection: socket.socket, direction: int) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(direction)


def small_jpeg(data: npt.NDArray[np.uint8], features: Sequence[TrackedFeatures] = ()) -> bytes:
    """Return an image as JPEG, made smaller where a side is longer than `MAX_SIDE` pixels.

    Pixels have the shape (height, width, 3) in RGB, or (height, width) in grey. Of its features,
    inliers are green, all others red.
    """
    import cv2  # at the first request of an image

    pixels: Any = data
    height, width = data.shape[:2]
    scale = min(MAX_SIDE / max(height, width), 1.0)
    if scale < 1.0:
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if data.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    elif features:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    for tracked in features:
        places = np.rint((tracked.points + 0.5) * scale - 0.5).astype(int).tolist()
        for place, inlier in zip(places, tracked.inliers.tolist(), strict=True):
            cv2.circle(pixels, place, 2, (60, 220, 60) if inlier else (60, 60, 230), 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


@contextlib.contextmanager
def serving(observer: Observer, run: str) -> Iterator[Path | None]:
    """Serve a run's monitor on its loop; yield the socket's path, `None` without one."""
    try:
        path = protocol.socket_of(run)
        server = Server(observer, asyncio.get_running_loop(), path)
    except (CommandError, OSError) as error:
        log.warning("no monitor can connect to this run: %s", error)
        yield None
        return
    try:
        yield path
    finally:
        server.stop()
