"""The process that writes, as the run sees it: a thread feeds it, and another reads its replies.

The loop puts events into the backlog, and calls nothing here that waits.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
from typing_extensions import Buffer

from events import Announcement
from nodes.data.mcap.layout import RecordingError
from nodes.data.recorder import pipe
from nodes.data.recorder.pipe import Backlog, Reply, Waiting, WriteRequest, command
from runtime.errors import MissingDependencyError, WireError
from runtime.wire import pack

_PAUSE = 0.005
"""Seconds between two looks at an empty backlog: cheaper than waking the thread at every event."""

_AT_ONCE = 1 << 16
"""Bytes that are handed over together."""

_IN_A_ROW = 16
"""Events between two chances for the loop to run, which needs Python's lock too."""

STANDSTILL = 10.0
"""Real seconds without any sign of life after which the process is given up: it may be stopped or
frozen, and then it would be waited for without end. A slow disk shows in the file's size."""

_LOOK = 0.5
"""Real seconds between two looks at it."""

_PIPE = 1 << 20
"""Bytes that the pipe holds: Linux allows no more without privileges."""


class WriterProcess:
    """Hands a backlog to a process that writes it.

    Args:
        failed: Called in a thread, once, with what ended the writing.
        complain: Called in a thread with what could not be recorded.

    Raises:
        RecordingError: The file cannot be made.
        MissingDependencyError: A library is not installed.
    """

    def __init__(
        self,
        request: WriteRequest,
        backlog: Backlog,
        failed: Callable[[RecordingError], None],
        complain: Callable[[str], None],
    ) -> None:
        self.path = request.path
        self.backlog = backlog
        self.error: RecordingError | None = None
        self.result = Reply("")
        """The last reply of the process."""
        self.unwritten = 0
        """Events that are not in the file."""
        self._handed = 0
        self._seen: tuple[object, ...] = ()
        self._seen_at = time.monotonic()
        self._cores = request.cores
        self._failed = failed
        self._complain = complain
        self._closing = threading.Event()
        self._end = 0
        self._child = subprocess.Popen(  # noqa: S603  # our own module
            command(request),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # so that a terminal's Ctrl-C does not reach it
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._replies = self._child.stdout
        self._file = self._child.stdin.fileno()
        with contextlib.suppress(OSError, AttributeError):  # elsewhere it is smaller
            fcntl.fcntl(self._file, fcntl.F_SETPIPE_SZ, _PIPE)
        first = self._reply()
        if first.what != "ready":
            self._child.stdin.close()
            self._replies.close()
            self._child.wait()
            if first.what == "missing":
                raise MissingDependencyError(first.text)
            raise RecordingError(first.text)
        self._feeder = threading.Thread(target=self._feed, name="recorder", daemon=True)
        self._listener = threading.Thread(target=self._listen, name="recorder", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._listener.start()
        self._feeder.start()

    def close(self, end: int, timeout: float | None = None) -> bool:
        """Have what still waits written, and tell whether the file is closed. Not on a loop.

        A process that somebody stopped is continued, and one that shows no sign of life for
        `STANDSTILL` seconds is ended; `error` then says so.

        Args:
            end: Time of the run's clock (ns) at which it ends.
            timeout: Real seconds to wait at most, after which it may be called again; if `None`,
                as long as the disk takes.
        """
        self._end = end
        self._closing.set()
        with contextlib.suppress(OSError):
            self._child.send_signal(signal.SIGCONT)
        until = math.inf if timeout is None else time.monotonic() + timeout
        for thread in (self._feeder, self._listener):
            while thread.is_alive():
                if (rest := until - time.monotonic()) <= 0.0:
                    return False
                thread.join(min(rest, _LOOK))
                self._end_if_still()
        try:
            self._child.wait(STANDSTILL)
        except subprocess.TimeoutExpired:  # it has sent its last reply
            self._child.kill()
            self._child.wait()
        if self.result.what in {"done", "error"}:  # one that was killed did not count
            self.unwritten += self._handed - self.result.written
        return True

    def still_for(self) -> float:
        """Return the real seconds for which the process has shown no sign of life."""
        try:
            size = Path(self.path).stat().st_size
            fields = Path(f"/proc/{self._child.pid}/stat").read_text().rpartition(")")[2].split()
            seen = self._handed, size, fields[11], fields[12]  # with the time of its threads
        except (OSError, IndexError):  # gone, or another system
            seen = self._handed, self._child.poll()  # type: ignore[assignment]
        now = time.monotonic()
        if seen != self._seen:
            self._seen, self._seen_at = seen, now
        return now - self._seen_at

    def standstill(self) -> RecordingError:
        """Return the error for a process that shows no sign of life."""
        return RecordingError(
            f"{self.path}: the process that writes it ({self._child.pid}) has taken nothing for "
            f"{STANDSTILL:g} s; what it had taken is kept"
        )

    def _end_if_still(self) -> None:
        if self.still_for() >= STANDSTILL and self._child.poll() is None:
            self.error = self.standstill()
            self._child.kill()

    # The thread that feeds.

    def _feed(self) -> None:
        self._stay_with_the_loop()
        try:
            self._hand_over()
            pipe.write_all(self._file, [pipe.end(self._end)])
        except OSError:
            pass  # the process is gone, and the listener knows why
        finally:
            assert self._child.stdin is not None
            with contextlib.suppress(OSError):
                self._child.stdin.close()
            self.backlog.release()
        while not self._closing.wait(_PAUSE):
            self._let_go()
        self._let_go()

    def _stay_with_the_loop(self) -> None:
        """Keep this thread off the busy cores: there it might wait for its turn with Python's lock.

        Then the loop would wait for that, too.
        """
        if not (self._cores and hasattr(os, "sched_setaffinity")):
            return
        if spare := os.sched_getaffinity(0) - {*self._cores}:
            os.sched_setaffinity(0, spare)

    def _hand_over(self) -> None:
        parts: list[Buffer] = []
        taken: list[Waiting] = []
        size = 0
        while True:
            closing = self._closing.is_set()  # before the look: what was put before it is written
            waiting = self.backlog.take()
            if waiting is not None:
                taken.append(waiting)
                size += waiting.size
                parts += self._pieces(waiting)
                if size < _AT_ONCE and len(taken) < _IN_A_ROW:
                    continue
            if taken:
                try:
                    pipe.write_all(self._file, parts)
                except OSError:
                    self.unwritten += len(taken)
                    raise
                self._handed += len(taken)
                for each in taken:
                    self.backlog.done(each)
                parts, taken, size = [], [], 0
            elif closing:
                return
            else:
                self._closing.wait(_PAUSE)

    def _pieces(self, waiting: Waiting) -> list[Buffer]:
        event = waiting.event
        what = pipe.ANNOUNCEMENT if isinstance(event, Announcement) else pipe.EVENT
        try:
            return pipe.pieces(waiting.time, pack(event), what)
        except WireError as error:
            self._complain(str(error))
            return []

    def _let_go(self) -> None:
        while (waiting := self.backlog.take()) is not None:
            self.unwritten += 1
            self.backlog.done(waiting)

    # The thread that listens.

    def _listen(self) -> None:
        while True:
            reply = self._reply()
            if reply.what == "complaint":
                self._complain(reply.text)
                continue
            break
        self._replies.close()
        self.result = reply
        if reply.what != "done":
            self.error = self.error or RecordingError(reply.text)
            self._failed(self.error)

    def _reply(self) -> Reply:
        line = self._replies.readline()
        try:
            return msgspec.json.decode(line, type=Reply)
        except msgspec.DecodeError:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(1.0)
            code = self._child.returncode
            return Reply("gone", f"{self.path}: the process that writes it ended with {code}")
