"""Command beside a run, with its output and all its processes, and its feed and inputs.

The feed sends by the native interface, and hands the answers to the hold. Its own thread sends,
in the order in which things are due: time waits for answers, never for a slot.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import select
import socket
import subprocess
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    ImuAnnouncement,
    PoseEstimate,
    TrackingEvent,
    TrackingLost,
)
from events.geometry import pose_matrix
from nodes.outside.native import Endpoint, LinkAnswer, LinkError, LinkTrajectory
from nodes.outside.native.client import RECORDS
from nodes.outside.native.rows import kind_of, row_kind, rows_of
from runtime.channels.hold import Hold
from runtime.errors import suggest
from runtime.sensors import sensor_kinds
from runtime.time.clock import SECOND
from runtime.workers.output import Output, how_it_ended

_AT_ONCE = 1 << 16  # bytes of a single read
_REST = 1.0  # seconds to read the last output of an ended program, as others may still write
_LATE = 3.0
"""Seconds beyond the grace time until the guard is killed, and the program with the guard."""


class Program:
    """A command in a process group of its own, below `nodes.outside.process.guard`.

    Whichever way the run ends, the program ends with it, and all that it has started.

    Args:
        printed: Called in a thread with each line that it prints, at once: it writes to a terminal
            of its own, so that no library keeps its output back.
        ended: Called in a thread, at once, when it has ended by itself, with how and what it last
            printed.

    Raises:
        OSError: The folder is missing.
    """

    def __init__(
        self,
        command: Sequence[str],  # a program and its arguments; no shell has a part in it
        folder: Path,
        environment: Mapping[str, str],
        *,
        grace: float,  # seconds that it may take to end once it gets SIGTERM
        processors: Sequence[int] = (),  # numbers of those that it may use; all if none
        printed: Callable[[str], None],
        ended: Callable[[str], None] = lambda _: None,
    ) -> None:
        # Its exit code, once it has ended; below 0 the signal that killed it.
        self.code: int | None = None
        self._grace = grace
        self._ended = ended
        self._output = Output(printed)
        self._closing = False
        self._over = threading.Event()
        self._ending = ""
        self._control, guard_end = socket.socketpair()
        guard = [sys.executable, "-I", "-S", str(Path(__file__).with_name("guard.py"))]
        numbers = ",".join(map(str, processors))
        self._terminal, prints = _terminal()
        with guard_end, os.fdopen(prints, "wb", buffering=0) as stdout:
            self._guard = subprocess.Popen(  # noqa: S603  # what the user's file says
                [*guard, str(guard_end.fileno()), str(grace), numbers, *command],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=subprocess.STDOUT,
                pass_fds=(guard_end.fileno(),),
                process_group=0,  # so that a terminal's Ctrl-C does not reach it
            )
        self._watcher = threading.Thread(target=self._watch, name=command[0], daemon=True)
        self._watcher.start()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait at most `seconds` for the program's end; return whether the program has ended."""
        return self._over.wait(seconds)

    def processes(self) -> list[int]:
        """Return the process IDs of the program and of its running descendants."""
        pids = [self._guard.pid]
        for pid in pids:
            for thread in Path(f"/proc/{pid}/task").glob("*/children"):
                with contextlib.suppress(OSError):
                    pids += map(int, thread.read_text("ascii").split())
        return pids[1:]

    def story(self) -> str:
        """Return how the program ended, or "still runs", and its last output."""
        return self._output.story(self._ending or "still runs")

    def request_end(self) -> None:
        """Request the program's end from the guard; return at once."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._control.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """End the program and all its processes. Takes up to its grace: not on a loop."""
        self.request_end()
        self._watcher.join(self._grace + _LATE)
        if self._watcher.is_alive():  # the guard is stopped
            self._guard.kill()
            self._watcher.join()

    def _watch(self) -> None:
        """Read the output and the exit code, until the guard has gone."""
        output, control = self._terminal, self._control.fileno()
        poll = select.poll()
        poll.register(output, select.POLLIN)
        poll.register(control, select.POLLIN)
        exit_code, more = b"", b"\0"
        while more:
            ready = {number for number, _ in poll.poll()}
            if output in ready and not self._read(output):
                poll.unregister(output)
            if control in ready:
                more = self._control.recv(_AT_ONCE)
                exit_code += more
                if not self._over.is_set() and (exit_code.endswith(b"\n") or not more):
                    self._report_end(output, exit_code.decode().strip())
        os.close(output)
        self._guard.wait()
        self._control.close()
        self._output.end()

    def _read(self, output: int) -> bool:
        data = b""
        with contextlib.suppress(OSError):  # a terminal whose writers are all closed
            data = os.read(output, _AT_ONCE)
        self._output.add(data)
        return bool(data)

    def _report_end(self, output: int, exit_code: str) -> None:
        """Report the program's end, after its last output is read."""
        poll, deadline = select.poll(), time.monotonic() + _REST
        poll.register(output, select.POLLIN)
        while poll.poll(0) and time.monotonic() < deadline and self._read(output):
            pass
        with contextlib.suppress(ValueError):
            self.code = int(exit_code)
        self._ending = (exit_code or "killed") if self.code is None else how_it_ended(self.code)
        self._over.set()
        if not self._closing:
            self._ended(self.story())


def _terminal() -> tuple[int, int]:
    """Return both ends of a terminal without a keyboard, or of a pipe if there is none to be had.

    What is written to it arrives as it is, and is not echoed.
    """
    try:
        read_end, write_end = os.openpty()
    except OSError:
        return os.pipe()
    tty.setraw(write_end)
    return read_end, write_end


KINDS = {"rgb": ("rgb8", 3), "grey": ("mono8", 1), "depth": ("depth32f", 4)}
"""Name of a kind of image on the link, and its bytes per pixel."""

Exposure = Sequence[tuple[int, str, Image | DepthImage]]
"""Images of the same stamp: index of the camera, kind on the link, and event."""


class Feed:
    """Sends exposures and measurements to a program, and its answers to the hold.

    Args:
        description: Sent to the program; see `nodes.outside.native.describe`.
        processes: Returns the numbers of the program's processes, whose costs are measured.
        options: Of the `Endpoint`: `slots`, `slot_bytes`, `gone`, `logged`, `orders`.
    """

    def __init__(
        self,
        path: Path,
        description: Mapping[str, Any],
        hold: Hold[LinkAnswer],
        processes: Callable[[], Sequence[int]],
        *,
        waits: bool,  # whether frames wait for a free slot, or are left out
        room: float,  # frames waiting to be sent, at most
        **options: Any,
    ) -> None:
        self._stamps: list[int] = []  # of the frames that were sent (ns)
        self.left_out = 0  # number of frames without a free slot, or without a program
        self._hold, self._processes, self._waits, self._room = hold, processes, waits, room
        self._initialised = self._closed = False
        self._names = [row["name"] for row in description["inputs"]]
        self._outbox: queue.SimpleQueue[tuple[int, Exposure, Sequence[Message]] | None] = (
            queue.SimpleQueue()
        )
        self._endpoint = Endpoint(
            path, description, answered=self._answer, ready=hold.back, **options
        )
        self._endpoint.listen()
        self.connect = self._endpoint.wait
        self._sender = threading.Thread(target=self._send_all, name=f"feed {path}", daemon=True)
        self._sender.start()

    @property
    def full(self) -> bool:
        """Return whether there is no room for a frame."""
        return self._outbox.qsize() >= self._room

    def send(self, stamp: int, exposure: Exposure, inputs: Sequence[Message]) -> None:
        """Queue inputs, and then a frame of a stamp (ns), for sending."""
        self._outbox.put((stamp, exposure, inputs))

    @property
    def promised(self) -> bool:
        """Return whether the program promised its final trajectory."""
        return self._endpoint.promised

    def finish(self, seconds: float) -> LinkTrajectory:
        """Send all frames that wait, and return the trajectory that the program sends then.

        Takes `seconds` (real time) at most.

        Raises:
            LinkError: It did not come, is empty, or has stamps of no frame.
        """
        until = time.monotonic() + seconds
        self._outbox.put(None)
        self._sender.join(seconds)
        trajectory = self._endpoint.finish(max(until - time.monotonic(), 0.0))
        if not (total := len(trajectory.stamps)):
            raise LinkError("expected its trajectory, found an empty one")
        if len(unknown := np.setdiff1d(trajectory.stamps, self._stamps)):
            raise LinkError(
                f"TRAJECTORY.stamp: expected stamps of frames, found {unknown[0]} "
                f"({len(unknown)} of {total} are of none)"
            )
        return trajectory

    def close(self) -> None:
        """Close the connection to the program; takes two seconds at most."""
        self._closed = True
        self._outbox.put(None)
        self._endpoint.close()
        self._sender.join(1.0)

    def _send_all(self) -> None:
        while (item := self._outbox.get()) is not None and not self._closed:
            stamp, exposure, inputs = item
            images = [(camera, kind, _pixels(kind, event)) for camera, kind, event in exposure]
            try:
                for message in inputs:
                    if self._endpoint.send_input(*message):
                        self._hold.sent(self._names[message.number], message.rows.tobytes())
                if not self._endpoint.send_frame(stamp, images, self._waits):
                    self.left_out += 1
                    continue
                self._stamps.append(stamp)
                self._hold.sent("frames", stamp.to_bytes(8, "little", signed=True))
                for camera, kind, image in images:
                    self._hold.sent(f"{kind} {camera}", image.data)
            except ValueError as error:  # an image is not as announced
                self._hold.fail(LinkError(str(error)))

    def _answer(self, answer: LinkAnswer) -> None:
        if (seconds := self._hold.waited(answer.stamp)) is not None:
            self._hold.answers.costs.measure(round(seconds * SECOND), self._processes())
        if self._hold.skips:
            self._endpoint.release(answer.stamp)
        self._initialised = self._initialised or answer.pose is not None
        useful = answer.pose is not None or bool(answer.before)
        useful = useful or (answer.status == "lost" and self._initialised)
        status = answer.status if answer.status in ("initialising", "lost") else ""
        self._hold.answer(answer.stamp, answer if useful else None, status)


def _pixels(kind: str, event: Image | DepthImage) -> npt.NDArray[Any]:
    """Return an image's pixels as the link has them, row by row."""
    if kind == "mono8" and event.data.ndim == 3:
        return cv2.cvtColor(event.data, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(event.data)


MOST_BYTES = 64 << 20  # most bytes waiting for the next frame; beyond, the oldest are dropped


class Message(NamedTuple):
    """Rows of an input: index of the input, when the last row came (ns), and the rows."""

    number: int
    arrived: int
    rows: npt.NDArray[Any]


class Inputs:
    """Inputs of a program: their choice, and what has come of them since the last frame.

    Args:
        names: Of each: a kind of sensor, the last part of a sensor's source, or an estimator.
    """

    def __init__(self, names: Sequence[str]) -> None:
        # Name, kind of the rows, and announcement of each; empty before `choose`.
        self.chosen: list[tuple[str, str, Announcement]] = []
        self.dropped = 0  # number of messages dropped for want of room
        self._names = names
        self._announced: list[Announcement] = []
        self._numbers: dict[str, int] = {}  # by source
        self._waiting: deque[Message] = deque()
        self._bytes = 0
        self._frames: dict[str, list[str]] = {}  # of each estimator, in the order of their use

    def record(self, announcement: Announcement) -> None:
        """Record a sensor or an estimator that may be chosen."""
        kinds = [sensor.announcement for sensor in sensor_kinds()]
        if isinstance(announcement, (EstimatorAnnouncement, *kinds)):
            self._announced.append(announcement)

    def choose(
        self,
        body: str,  # source of the body whose sensors are meant; empty for the first found
        imu: ImuAnnouncement | None,  # comes first if the names mean no IMU
    ) -> Iterable[str]:
        """Choose among what was announced, and yield an error for each that is missing."""
        self.chosen = []
        for name in self._names:
            sensor = self._find(name, body)
            if sensor is None:
                sources = [announced.source for announced in self._announced]
                listing = f"found {', '.join(sources) or 'none'}{suggest(name, sources)}"
                yield f"reads: expected a sensor or an estimator called {name}, {listing}"
            elif first := next((n for n, _, chosen in self.chosen if chosen is sensor), ""):
                yield f"reads: expected each once, found {sensor.source} as {first} and as {name}"
            else:
                self.chosen.append((name, _kind(sensor), sensor))
                body = body or sensor.source.rpartition("/")[0]
        if imu is not None and all(kind != "imu" for _, kind, _ in self.chosen):
            self.chosen.insert(0, ("imu", "imu", imu))
        self._numbers = {chosen.source: number for number, (*_, chosen) in enumerate(self.chosen)}

    def _find(self, name: str, body: str) -> Announcement | None:
        sensor = next((kind for kind in sensor_kinds() if kind.name == name), None)
        for announced in self._announced:
            source, estimator = announced.source, isinstance(announced, EstimatorAnnouncement)
            if sensor is not None and isinstance(announced, sensor.announcement):
                if body in ("", source.rpartition("/")[0]):
                    return announced
            elif source == name or (not estimator and source.endswith(f"/{name}")):
                return announced
        return None

    def store(self, event: Event, now: int) -> str:
        """Store an event until the next frame; return the name of its input, if that is news."""
        number = self._numbers.get(event.source)
        rows = None if number is None else self._rows(event, self.chosen[number][1])
        if number is None or rows is None:
            return ""
        self._waiting.append(Message(number, now, rows))
        self._bytes += rows.nbytes
        while self._bytes > MOST_BYTES and len(self._waiting) > 1:
            self._bytes -= self._waiting.popleft().rows.nbytes
            self.dropped += 1
        return "" if isinstance(event, TrackingEvent) else self.chosen[number][0]

    def drain(self) -> list[Message]:
        """Return what has come since, in the order of arrival; rows of an input in one message."""
        rows_of_inputs = []
        for number, group in itertools.groupby(self._waiting, lambda message: message.number):
            messages = [*group]
            scans = self.chosen[number][1] == "lidar_scan"
            for part in [[message] for message in messages] if scans else [messages]:
                rows = np.concatenate([message.rows for message in part])
                rows_of_inputs.append(Message(number, part[-1].arrived, rows))
        self._waiting.clear()
        self._bytes = 0
        return rows_of_inputs

    def _rows(self, event: Event, kind: str) -> npt.NDArray[Any] | None:
        """Return an event as rows of a kind; `None` if it is another's."""
        if isinstance(event, PoseEstimate | TrackingLost):
            return self._estimate(event)
        return rows_of(event) if kind_of(event) == kind else None

    def _estimate(self, event: PoseEstimate | TrackingLost) -> npt.NDArray[Any]:
        frames = self._frames.setdefault(event.source, [])
        pose, velocity, covariance = np.full((3, 4), np.nan), (np.nan,) * 3, np.full((6, 6), np.nan)
        if isinstance(event, PoseEstimate):
            if event.frame_id not in frames:
                frames.append(event.frame_id)
            pose = pose_matrix(event.position, event.orientation)[:3]
            velocity = event.velocity or velocity
            if event.covariance:
                covariance = np.reshape(event.covariance, (6, 6))
            frame = frames.index(event.frame_id)
        else:
            frame = max(len(frames) - 1, 0)
        row = event.stamp, frame, pose, velocity, covariance
        return np.array([row], RECORDS["pose_estimate"])


def _kind(announced: Announcement) -> str:
    for sensor in sensor_kinds():
        if isinstance(announced, sensor.announcement):
            return row_kind(sensor)
    return "pose_estimate"
