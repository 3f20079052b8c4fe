"""Latency of an estimator: its results go out no earlier than its declared time after the image.

The time counts from when the estimator takes the image, as that of a worker's call does. While a
result waits, the estimator is busy and takes no further image. So a tracker called in `run` itself
gives the same estimates, at the same times and of the same images, as one in a worker.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any

from events import DepthImage, Event, Image, LidarScan
from runtime.time.clock import Clock

_REMEMBERED = 1024  # images whose arrival is known, at most


class ResultQueue:
    """Queue of results of images, each sent once its latency is over, in the order of `add`.

    Args:
        latency: From the arrival of an image to its result, ns of the clock.
        start: Runs a coroutine as a task of the node.
    """

    def __init__(
        self, clock: Clock, latency: int, start: Callable[[Coroutine[Any, Any, None]], None]
    ) -> None:
        self._clock, self._latency, self._start = clock, latency, start
        self._arrivals: dict[int, int] = {}  # by stamp of the image, ns
        self._waiting: deque[tuple[int, Callable[[], None]]] = deque()
        self._empty = asyncio.Event()
        self._is_sending = False

    def record_arrival(self, frame: Any) -> None:
        """Record now as the arrival time of an image, a scan, or the images of a tuple."""
        for event in frame if isinstance(frame, tuple) else (frame,):
            if isinstance(event, Image | DepthImage | LidarScan):
                self._arrivals[event.stamp] = self._clock.now()
        while len(self._arrivals) > _REMEMBERED:
            del self._arrivals[next(iter(self._arrivals))]

    def has_arrival(self, image: Event) -> bool:
        """Return whether an image's arrival is recorded, or may have been and is forgotten."""
        return image.stamp in self._arrivals or len(self._arrivals) == _REMEMBERED

    def is_due(self, image: Event) -> bool:
        """Return whether an image's result may go out now: in time, and after those before it."""
        return not self._waiting and self._due(image) <= self._clock.now()

    def add(self, image: Event, send: Callable[[], None]) -> None:
        """Schedule a call of `send` when an image's result is due, after earlier results."""
        self._waiting.append((self._due(image), send))
        if not self._is_sending:
            self._is_sending = True
            self._start(self._send_all())

    def _due(self, image: Event) -> int:
        arrival = self._arrivals.get(image.stamp)
        return 0 if arrival is None else arrival + self._latency

    async def wait(self) -> None:
        """Wait until no result is left."""
        while self._waiting:
            self._empty.clear()
            await self._empty.wait()

    async def _send_all(self) -> None:
        done: concurrent.futures.Future[None] = concurrent.futures.Future()
        done.set_result(None)
        try:
            while self._waiting:
                due, send = self._waiting[0]
                if due > self._clock.now():  # as the call of a worker that is done already
                    await self._clock.beside(done, due - self._clock.now())
                self._waiting.popleft()
                send()
        finally:
            self._is_sending = False
            self._empty.set()
