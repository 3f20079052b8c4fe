"""A process seen from outside: its output, the report of its end, and its costs on this machine.

Costs (real time, processor time, memory) differ from run to run, so none of them enters a digest.
"""

from __future__ import annotations

import collections
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from runtime.time.schedule import DurationHistogram

_LONGEST = 4096  # bytes of a line at most; a longer line is cut into several
_KEPT = 20  # last lines reported of an ended process
LINES = 100  # lines handed on per real second of a process; lines beyond are only counted

# A lone carriage return, as of a progress bar, ends a line, too; the next byte may be its "\n".
_LINE_END = re.compile(rb"\r?\n|\r(?!\Z)")

_ESCAPES = re.compile(
    r"\x1b\[[0-?]*[ -/]*[@-~]"  # colours, moves of the cursor
    r"|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?"  # titles
    r"|\x1b[ -/]*[0-~]?|[^\t\x20-\x7e\xa0-\U0010ffff]"  # all else that controls
)

_CPUCLOCK_SCHED = 2
"""Kind of clock in the numbers of processes' clocks; see ``clock_getcpuclockid(3)`` and Linux's
``posix-timers.h``."""


def plain_lines(data: bytes | bytearray) -> Iterable[str]:
    """Yield another process's text in bounded lines, without terminal control codes."""
    for line in _LINE_END.split(data.removesuffix(b"\r")):
        for begin in range(0, max(len(line), 1), _LONGEST):
            text = line[begin : begin + _LONGEST].decode(errors="replace")
            if text.isprintable():
                yield text.rstrip()
                continue
            yield " ".join(_ESCAPES.sub("", text).splitlines()).rstrip()


class Throttle:
    """Hands on lines from any thread, `LINES` a second at most, and then their number."""

    def __init__(
        self, printed: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._printed, self._now = printed, now
        self._lock = threading.Lock()
        self._second, self._shown = 0, 0

    def __call__(self, line: str) -> None:
        """Hand a line on, unless there were too many within a second."""
        with self._lock:
            if (second := int(self._now())) != self._second:
                self._say_how_many_more()
                self._second, self._shown = second, 0
            self._shown += 1
            if self._shown <= LINES:
                self._printed(line)

    def take(self, text: bytes | bytearray) -> None:
        """Hand the lines of a text on; beyond the limit only count, at little cost."""
        with self._lock:
            if self._shown > LINES and int(self._now()) == self._second:
                self._shown += text.count(b"\n") + 1
                return
        for line in plain_lines(text):
            self(line)

    def end(self) -> None:
        """Say how many lines were left out at last."""
        with self._lock:
            self._say_how_many_more()
            self._shown = 0

    def _say_how_many_more(self) -> None:
        if self._shown > LINES:
            self._printed(f"({self._shown - LINES} more lines)")


class Output:
    """Lines printed by a process, without their ends; the last are for a report."""

    def __init__(self, printed: Callable[[str], None]) -> None:
        self._printed = printed
        self._begun = b""
        self._last: collections.deque[str] = collections.deque(maxlen=_KEPT)

    def take(self, data: bytes) -> None:
        """Take bytes read from the process."""
        *lines, begun = _LINE_END.split(self._begun + data)
        while len(begun.removesuffix(b"\r")) > _LONGEST:
            lines.append(begun[:_LONGEST])
            begun = begun[_LONGEST:]
        self._begun = begun
        for line in lines:
            self._take_line(line)

    def end(self) -> None:
        """Take the unfinished last line."""
        if self._begun:
            self._take_line(self._begun)
            self._begun = b""

    def story(self, what: str) -> str:
        """Return the report of the process's end, with its last lines."""
        if not self._last:
            return f"{what}; it said nothing"
        return f"{what}; its last output:\n" + "\n".join(self._last)

    def _take_line(self, line: bytes) -> None:
        for text in plain_lines(line):
            self._last.append(text)
            self._printed(text)


def how_it_ended(code: int) -> str:
    """Return an exit code in words; a negative code is the signal of the kill."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"killed by signal {-code} ({signal.strsignal(-code) or 'unknown'})"


class Costs:
    """Costs of all processes of a worker, in constant memory; used from any thread.

    Attributes:
        wall: Real time of each (ns), from its arguments in the process to its result.
        cpu: Processor time of all threads of the process (ns), since the call before: what they go
            on doing after an answer is counted with the next one.
        peak: Peak memory (bytes) of any of the processes; 0 if unknown.
        latency: Declared seconds of a call on the run's clock; `None` if it varied.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.calls = 0
        self.wall = DurationHistogram()
        self.cpu = DurationHistogram()
        self.peak = 0
        self.processes = 0
        self.latency: float | None = None
        self._used: dict[int, int] = {}

    def add(self, wall: int, cpu: int) -> None:
        """Count a call, with its real and processor time (ns)."""
        with self._lock:
            self.calls += 1
            self.wall.add(wall)
            self.cpu.add(cpu)

    def measure(self, wall: int, pids: Iterable[int]) -> None:
        """Count a call of processes without own timing: processor time since the call before."""
        before, self._used = self._used, {pid: cpu_time(pid) for pid in pids}
        for pid in self._used:
            self.look_at(pid)
        self.processes = max(self.processes, len(self._used))
        if before and self._used:
            self.add(wall, sum(max(t - before.get(pid, 0), 0) for pid, t in self._used.items()))

    def look_at(self, pid: int) -> None:
        """Note how much memory a process has had until now."""
        peak = peak_memory(pid)
        with self._lock:
            self.peak = max(self.peak, peak)


def cpu_time(pid: int) -> int:
    """Return the processor time (ns) of all threads of a process; 0 if gone."""
    try:
        return time.clock_gettime_ns(~pid << 3 | _CPUCLOCK_SCHED)
    except OSError:
        return 0


def peak_memory(pid: int) -> int:
    """Return the peak resident memory (bytes) of a process; 0 if unknown.

    From ``/proc``: the figure of `resource.getrusage` begins with the memory of the parent.
    """
    try:
        status = Path(f"/proc/{pid}/status").read_bytes()
    except OSError:
        return 0
    found = re.search(rb"VmHWM:\s+(\d+) kB", status)
    return int(found[1]) << 10 if found else 0
