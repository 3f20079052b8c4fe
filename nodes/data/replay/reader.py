"""What a recording is to a replay, whatever its format: announcements, and events in order of time.

All of it is for threads beside the loop, and knows no clock: times count from the recording's
beginning.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

from events import Announcement, Event

MOST_TROUBLE = 20
"""Different complaints about a recording that are kept."""


class ReplayError(ValueError):
    """A recording cannot be read; the message names the file and says what is wrong."""


class Timed(NamedTuple):
    """An event, and when it was published (ns from the recording's beginning)."""

    time: int
    event: Event


class Wants(Protocol):
    """Tells whether events of a type and source are to be sent; what is not is not decoded."""

    def __call__(self, kind: type[Event], source: str) -> bool:
        """Tell it."""


class Reader(ABC):
    """Reads a recording.

    Attributes:
        trouble: What could not be read so far, in words.
        left_out: How many events could not be read.
    """

    def __init__(self) -> None:
        self.trouble: list[str] = []
        self.left_out = 0

    @abstractmethod
    def announcements(self) -> Sequence[Announcement]:
        """Return what its nodes announced, or what can be concluded instead.

        Raises:
            ReplayError: It cannot be read.
        """

    @abstractmethod
    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield the events from `start` to before `end`, in the order in which they were sent.

        Events may share arrays with nothing that changes. Their stamps are on the same clock as
        the times.

        Args:
            start: Nanoseconds.
            end: Nanoseconds; `None` for all there are.
            wants: Which of them.

        Raises:
            ReplayError: It cannot be read.
        """

    def end(self) -> int | None:
        """Return when it ends (ns), if it says so; else it ends with its last event."""
        return None

    def complain(self, what: str) -> None:
        """Note what cannot be read; of more than anyone would look at, only that there is more."""
        if what in self.trouble or len(self.trouble) > MOST_TROUBLE:
            return
        self.trouble.append(what if len(self.trouble) < MOST_TROUBLE else "and more of that kind")

    def close(self) -> None:  # noqa: B027  # most hold nothing
        """Let go of what it holds."""
