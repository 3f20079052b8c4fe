"""Notices a loop that does not turn, and reports which node stands on which line.

A thread looks at the loop's thread a few times per limit. Only where it finds the loop busy does
it ask it to sign a note; a note that stays unsigned for the limit is a stall. An idle loop is
never woken, and events cost nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import selectors
import threading
import time
from collections import Counter
from collections.abc import Callable
from types import FrameType

from runtime import code_location, lockstep
from runtime.frames import frame_of
from runtime.summary import Stall

_LONGEST_PAUSE = 0.05
"""Seconds between two looks at most; a run's end waits for the last of them."""

_WAITING = {selectors.__file__, lockstep.__file__}
"""Modules in which a loop that has nothing to do waits…"""

_LOOPS = {asyncio.base_events.__file__, asyncio.runners.__file__}
"""…when called from these. (uvloop, being compiled, shows nothing but `Runner.run`.) A node that
waits for a lock or a child's output is not idle: it blocks the loop."""


class LoopWatchdog:
    """Watches the loop of the thread that makes it.

    Args:
        loop: The loop.
        limit: Real seconds without a turn that are a stall; 0 watches nothing.
        report: Called with each stall once it is over; from the watchdog's thread.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, limit: float, report: Callable[[Stall], None]
    ) -> None:
        self._loop = loop
        self._limit = limit
        self._report = report
        self._thread_id = threading.get_ident()
        self._signed = threading.Event()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self.stalls: Counter[str] = Counter()
        self.longest: dict[str, Stall] = {}

    def start(self) -> None:
        """Begin to watch."""
        if self._limit > 0:
            self._thread.start()

    def stop(self) -> None:
        """Watch no more."""
        self._end.set()
        self._signed.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        pause = min(self._limit / 4, _LONGEST_PAUSE)
        while not self._end.is_set():
            time.sleep(pause)  # an `Event.wait` with a time-out costs five times as much
            frame = frame_of(self._thread_id)
            if frame is None or idle(frame):
                continue
            del frame
            self._signed.clear()
            if self._end.is_set():  # `stop` may have signed just before the note was wiped
                return
            asked = time.monotonic()
            try:
                self._loop.call_soon_threadsafe(self._signed.set)
            except RuntimeError:  # closed
                return
            if self._signed.wait(self._limit) or self._end.is_set():
                continue
            node, line = code_location.of_thread(frame_of(self._thread_id))
            self._signed.wait()
            if not self._end.is_set():
                self._count(Stall(node, line, time.monotonic() - asked))

    def _count(self, stall: Stall) -> None:
        self.stalls[stall.node] += 1
        longest = self.longest.get(stall.node)
        if longest is None or stall.seconds > longest.seconds:
            self.longest[stall.node] = stall
        with contextlib.suppress(Exception):  # a report that fails must not end the watch
            self._report(stall)


def idle(frame: FrameType | None) -> bool:
    """Return whether a loop whose thread has this frame has nothing to do."""
    while frame is not None and frame.f_code.co_filename in _WAITING:
        frame = frame.f_back
    return frame is None or frame.f_code.co_filename in _LOOPS
