"""Clocks of programs outside: whether stamps are ours, and by how much others' are off.

A stamp may be of our clock, which programs know by our answers to ``TIMESYNC``, or of the
program's clock, which we know by its answers to our ``TIMESYNC``. The clock by which the first pose
is younger counts. If neither is possible, the earliest arrival counts as without delay, and the
differences between stamps stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from visnav_mavlink.links import Sender, mav
from visnav_mavlink.vehicle import SECOND

LATEST = 2 * SECOND  # age of a first pose that may still be late by itself
OLDEST = 10 * SECOND  # age of a later one
EARLIEST = -SECOND // 10  # age that is an error of a synchronized clock
QUICK = SECOND // 50  # round trip of a quick answer
PERIOD = SECOND  # of requests for programs' clocks
MOST_CLOCKS = 64


@dataclass
class Clock:
    """A program's clock.

    Attributes:
        method: Source of the correction of its stamps; empty before the first.
        correction: What is added to its stamps, ns.
        offset: Ours less its own by ``TIMESYNC``, ns, whose answer took `round_trip`.
    """

    method: Literal["", "nothing", "TIMESYNC", "the earliest arrival"] = ""
    correction: int = 0
    offset: int = 0
    round_trip: int | None = None


class Clocks:
    """All programs' clocks.

    Args:
        delay: Of poses behind their corrected stamps, ns, which is reported with the correction.
        send: Sends a message to all programs.
        report_once: Sends a sentence, the first time, to all programs and to the log.
    """

    def __init__(
        self, delay: int, send: Callable[[Any], None], report_once: Callable[[str], None]
    ) -> None:
        self.delay, self._send, self._report_once = delay, send, report_once
        self._clocks: dict[Sender, Clock] = {}
        self._due = 0

    def update(self, now: int) -> None:
        """Request the time of all clocks, once a period."""
        if now >= self._due:
            self._due = now + PERIOD
            self._send(mav.MAVLink_timesync_message(0, now))

    def handle(self, sender: Sender, answer: Any, now: int) -> None:
        """Store the offset of a quick answer; the newest, as clocks drift if a run falls behind."""
        round_trip, clock = now - answer.ts1, self._clock_of(sender)
        longest = SECOND if clock.round_trip is None else max(2 * clock.round_trip, QUICK)
        if answer.tc1 and 0 <= round_trip <= longest:
            clock.offset = answer.ts1 + round_trip // 2 - answer.tc1
            clock.round_trip = round_trip

    def stamp(self, sender: Sender, stamp: int, now: int) -> int:
        """Return a stamp of a sender's (ns) in our clock, at its arrival, without the delay."""
        age, clock = now - stamp, self._clock_of(sender)
        if clock.method == "the earliest arrival":
            clock.correction = min(clock.correction, age)
        elif clock.method == "TIMESYNC":
            clock.correction = clock.offset
        if (
            not clock.method
            or (clock.method == "the earliest arrival" and clock.round_trip is not None)
            or not EARLIEST <= age - clock.correction < OLDEST
        ):
            self._decide(sender, clock, age)
        return min(stamp + clock.correction, now)

    def _decide(self, sender: Sender, clock: Clock, age: int) -> None:
        before = clock.method
        clock.method, clock.correction = "the earliest arrival", age
        youngest = LATEST
        if EARLIEST <= age < youngest:
            clock.method, clock.correction, youngest = "nothing", 0, age
        if clock.round_trip is not None and EARLIEST <= age - clock.offset < youngest:
            clock.method, clock.correction = "TIMESYNC", clock.offset
        if clock.correction and clock.method != before:
            system, component = sender
            off = abs(clock.correction) / SECOND
            sign = "behind" if clock.correction > 0 else "ahead"
            self._report_once(
                f"poses of {system}/{component}: stamps are {off:.1f} s {sign}, of another clock: "
                f"corrected by {clock.method}; delay {self.delay / 1e6:g} ms"
            )

    def _clock_of(self, sender: Sender) -> Clock:
        if sender not in self._clocks and len(self._clocks) >= MOST_CLOCKS:
            self._clocks.clear()
        return self._clocks.setdefault(sender, Clock())
