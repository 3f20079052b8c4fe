"""Costs of processes: real time, processor time, memory.

They differ from run to run, so none of them enters a digest.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from runtime.time.clock import DurationHistogram

_CPUCLOCK_SCHED = 2
"""Kind of clock in the numbers of processes' clocks; see ``clock_getcpuclockid(3)`` and Linux's
``posix-timers.h``."""


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
    match = re.search(rb"VmHWM:\s+(\d+) kB", status)
    return int(match[1]) << 10 if match else 0
