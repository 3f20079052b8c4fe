"""A command that runs beside the run: its output, its end, and the end of all it has started."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from runtime.workers.output import Output, how_it_ended

_AT_ONCE = 1 << 16
"""Bytes that are read together."""

_REST = 1.0
"""Seconds for the last output of a program that has ended, which others may still write to."""

_LATE = 3.0
"""Seconds beyond its grace after which a guard is killed, and with it the program."""


class Program:
    """A command in a process group of its own, below `nodes.outside.process.guard`.

    Whichever way the run ends, the program ends with it, and all that it has started.

    Args:
        command: A program and its arguments; no shell has a part in it.
        folder: Working folder.
        environment: All variables.
        grace: Seconds that it may take to end once it gets SIGTERM.
        printed: Called in a thread with each line that it prints, at once: it writes to a terminal
            of its own, so that no library keeps its output back.
        ended: Called in a thread, at once, when it has ended by itself, with how and what it last
            printed.

    Attributes:
        code: Its exit code, once it has ended; below 0 the signal that killed it.

    Raises:
        OSError: The folder is missing.
    """

    def __init__(
        self,
        command: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        *,
        grace: float,
        printed: Callable[[str], None],
        ended: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.code: int | None = None
        self._grace = grace
        self._ended = ended
        self._output = Output(printed)
        self._closing = False
        self._over = threading.Event()
        self._how = ""
        self._control, theirs = socket.socketpair()
        guard = [sys.executable, "-I", "-S", str(Path(__file__).with_name("guard.py"))]
        self._terminal, prints = _terminal()
        with theirs, os.fdopen(prints, "wb", buffering=0) as stdout:
            self._guard = subprocess.Popen(  # noqa: S603  # what the user's file says
                [*guard, str(theirs.fileno()), str(grace), *command],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=subprocess.STDOUT,
                pass_fds=(theirs.fileno(),),
                process_group=0,  # so that a terminal's Ctrl-C does not reach it
            )
        self._watcher = threading.Thread(target=self._watch, name=command[0], daemon=True)
        self._watcher.start()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it has ended, and tell whether it has."""
        return self._over.wait(seconds)

    def processes(self) -> list[int]:
        """Return the numbers of its process, and of all that it has started and that still run."""
        found = [self._guard.pid]
        for pid in found:
            for thread in Path(f"/proc/{pid}/task").glob("*/children"):
                with contextlib.suppress(OSError):
                    found += map(int, thread.read_text("ascii").split())
        return found[1:]

    def story(self) -> str:
        """Return how it ended, if it did, and what it last printed."""
        return self._output.story(self._how or "still runs")

    def leave(self) -> None:
        """Have it ended, and wait for nothing."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._control.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """End it, and all that it has started. Takes up to its grace: not on a loop."""
        self.leave()
        self._watcher.join(self._grace + _LATE)
        if self._watcher.is_alive():  # somebody stopped the guard
            self._guard.kill()
            self._watcher.join()

    def _watch(self) -> None:
        """Read what it prints, and note its end, until its guard has gone."""
        output, control = self._terminal, self._control.fileno()
        news = select.poll()
        news.register(output, select.POLLIN)
        news.register(control, select.POLLIN)
        told, more = b"", b"\0"
        while more:
            ready = {number for number, _ in news.poll()}
            if output in ready and not self._read(output):
                news.unregister(output)
            if control in ready:
                more = self._control.recv(_AT_ONCE)
                told += more
                if not self._over.is_set() and (told.endswith(b"\n") or not more):
                    self._note_end(output, told.decode().strip())
        os.close(output)
        self._guard.wait()
        self._control.close()
        self._output.end()

    def _read(self, output: int) -> bool:
        data = b""
        with contextlib.suppress(OSError):  # a terminal that nobody writes to any more
            data = os.read(output, _AT_ONCE)
        self._output.take(data)
        return bool(data)

    def _note_end(self, output: int, told: str) -> None:
        """Tell of its end, once the last that it printed is read."""
        rest, until = select.poll(), time.monotonic() + _REST
        rest.register(output, select.POLLIN)
        while rest.poll(0) and time.monotonic() < until and self._read(output):
            pass
        with contextlib.suppress(ValueError):
            self.code = int(told)
        self._how = (told or "killed") if self.code is None else how_it_ended(self.code)
        self._over.set()
        if not self._closing:
            self._ended(self.story())


def _terminal() -> tuple[int, int]:
    """Return both ends of a terminal without a keyboard, or of a pipe if there is none to be had.

    What is written to it arrives as it is, and is not echoed.
    """
    try:
        ours, theirs = os.openpty()
    except OSError:
        return os.pipe()
    tty.setraw(theirs)
    return ours, theirs
