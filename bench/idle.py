"""What a nearly idle run costs: processor time of one 100 Hz timer node over ten seconds."""

from __future__ import annotations

import time

import msgspec

from runtime import Node, Tick, every
from runtime.config.reading import parse
from runtime.run.execute import execute


class IdleRow(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Attributes:
        hz: Rate of the timer.
        seconds: Length of the run.
        ticks: How many came.
        cpu_percent: Of one core, all threads of the process together.
    """

    hz: float
    seconds: float
    ticks: int
    cpu_percent: float


_marks: list[tuple[float, float]] = []


class Timer(Node):
    """Does nothing, a hundred times a second."""

    @every(hz=100)
    def tick(self, _: Tick) -> None:
        """Note the time, real and of the processor."""
        _marks.append((time.monotonic(), time.process_time()))


def measure(seconds: float = 10.0) -> IdleRow:
    """Run the timer for so long."""
    _marks.clear()
    node = {"name": "timer", "type": f"{__name__}:Timer"}
    execute(parse({"run": {"clock": "real", "duration": seconds}, "nodes": [node]}, "bench idle"))
    (begin, cpu_begin), (end, cpu_end) = _marks[0], _marks[-1]
    return IdleRow(
        hz=100,
        seconds=end - begin,
        ticks=len(_marks),
        cpu_percent=100 * (cpu_end - cpu_begin) / (end - begin),
    )
