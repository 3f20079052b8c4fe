"""Times: nanoseconds of the run's clock to seconds and nanoseconds of a ROS message, and back."""

from __future__ import annotations

import msgspec

from runtime.time.schedule import SECOND

AHEAD = SECOND
"""How far ahead of the run's clock a stamp from outside may be (ns)."""

Time = tuple[int, int]
"""The time in a message: seconds and nanoseconds."""


class Stamps(msgspec.Struct, frozen=True):
    """Converts stamps of the run's clock to times in messages, and back.

    Attributes:
        offset: Nanoseconds to add on the way out.
    """

    offset: int = 0

    def out(self, stamp: int) -> Time:
        """Return the seconds and nanoseconds of a stamp."""
        return divmod(stamp + self.offset, SECOND)

    def stamp(self, seconds: int, nanoseconds: int) -> int:
        """Return a message's time on the run's clock (ns), whether it is one of the run or not."""
        return int(seconds) * SECOND + int(nanoseconds) - self.offset

    def back(self, seconds: int, nanoseconds: int, now: int) -> int:
        """Return a message's time on the run's clock (ns).

        Args:
            seconds: Of the message; both 0 stand for now.
            nanoseconds: Of the message.
            now: On the run's clock (ns).

        Raises:
            ValueError: It lies before the run, or ahead of its clock.
        """
        if seconds == 0 and nanoseconds == 0:
            return now
        stamp = self.stamp(seconds, nanoseconds)
        if not 0 <= stamp <= now + AHEAD:
            raise ValueError(
                f"stamp: expected a time of this run, from 0 s to {now / SECOND:.3f} s, "
                f"found {stamp / SECOND:.3f} s"
            )
        return stamp
