"""What feeds a program by the native interface, and hands its answers to the hold.

A thread of its own sends, in the order in which things are due: time never waits for a slot, but
for answers only.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events import DepthImage, Image
from nodes.outside.native import Endpoint, LinkAnswer, LinkError
from runtime.channels.hold import Hold

KINDS = {"rgb": ("rgb8", 3), "grey": ("mono8", 1), "depth": ("depth32f", 4)}
"""What the link calls a kind of image, and the bytes of its pixels."""

Exposure = Sequence[tuple[int, str, Image | DepthImage]]
"""Images of one stamp: number of the camera, kind for the link, and event."""


class Feed:
    """Sends exposures and samples of the IMU to a program, and takes its answers.

    Args:
        path: Of the socket.
        description: What the program is told; see `nodes.outside.native.describe`.
        hold: What the answers are for.
        story: Called in a thread with why it is gone; returns what else is known.
        processes: Returns the numbers of the program's processes, whose costs are measured.
        skips: Whether an answer says that none will come for the frames before it.
        options: Of the `Endpoint`: `slots`, `slot_bytes`, `logged`.
    """

    def __init__(
        self,
        path: Path,
        description: Mapping[str, Any],
        hold: Hold[LinkAnswer],
        story: Callable[[str], str],
        processes: Callable[[], Sequence[int]],
        *,
        skips: bool,
        **options: Any,
    ) -> None:
        self.unanswered: dict[int, int] = {}
        """Stamps of the frames that are sent, or about to be, and real times of that (ns)."""
        self.why_gone = ""
        self._hold, self._story, self._skips, self._processes = hold, story, skips, processes
        self._initialised = self._closed = False
        self._outbox: queue.SimpleQueue[tuple[Exposure, npt.NDArray[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._endpoint = Endpoint(
            path, description, answered=self._take, gone=self._lose, skips=skips, **options
        )
        self._endpoint.listen()
        self.connect = self._endpoint.wait
        self._sender = threading.Thread(target=self._send_all, name=f"feed {path}", daemon=True)
        self._sender.start()

    def send(self, exposure: Exposure, samples: npt.NDArray[Any]) -> None:
        """Have samples of the IMU sent, and then a frame; returns at once."""
        self.unanswered[exposure[0][2].stamp] = time.monotonic_ns()
        self._outbox.put((exposure, samples))

    def close(self) -> None:
        """Say goodbye to the program; takes two seconds at most."""
        self._closed = True
        self._outbox.put(None)
        self._endpoint.close()
        self._sender.join(1.0)

    def _send_all(self) -> None:
        while (due := self._outbox.get()) is not None and not self._closed:
            exposure, samples = due
            stamp = exposure[0][2].stamp
            images = [(camera, kind, _pixels(kind, event)) for camera, kind, event in exposure]
            try:
                if len(samples) and self._endpoint.send_imu(samples):
                    self._hold.sent("imu", samples.tobytes())
                if self._endpoint.send_frame(stamp, images):
                    self._hold.sent("frames", stamp.to_bytes(8, "little", signed=True))
                    for camera, kind, image in images:
                        self._hold.sent(f"{kind} {camera}", image.data)
            except ValueError as error:  # an image is not as announced
                self._hold.fail(LinkError(str(error)))

    def _take(self, answer: LinkAnswer) -> None:
        if sent := self.unanswered.get(answer.stamp):
            costs = self._hold.answers.costs
            costs.measure(time.monotonic_ns() - sent, self._processes())
        earlier = [stamp for stamp in list(self.unanswered) if stamp < answer.stamp]
        for stamp in (*(earlier if self._skips else ()), answer.stamp):
            self.unanswered.pop(stamp, None)
        self._initialised = self._initialised or answer.pose is not None
        useful = answer.pose is not None or (answer.status == "lost" and self._initialised)
        says = answer.status if answer.status in ("initialising", "lost") else ""
        self._hold.answer(answer.stamp, answer if useful else None, says)

    def _lose(self, why: str) -> None:
        """Take note that the program is gone, and of another that takes its place."""
        self.why_gone = why
        self._hold.gone(self._story(why))
        while not self._closed:
            with contextlib.suppress(LinkError):
                self._endpoint.wait(1.0)
                self.unanswered.clear()
                self._hold.back()
                return


def _pixels(kind: str, event: Image | DepthImage) -> npt.NDArray[Any]:
    """Return an image's pixels as the link has them, row by row."""
    if kind == "mono8" and event.data.ndim == 3:
        return cv2.cvtColor(event.data, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(event.data)
