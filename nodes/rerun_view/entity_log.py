"""A log of entities with the run's two time lines, for everything that writes into Rerun."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from events import Event

E = TypeVar("E", bound=Event)

Numbered = tuple[int, E]
"""How many events came before, and the event."""


class EntityLog:
    """Logs entities.

    Args:
        rr: The library.
        stream: Its recording.
    """

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr = rr
        self.stream = stream
        stream.set_log_time_enabled(False)  # one's own time lines: ``run`` and ``event``
        stream.set_log_tick_enabled(False)

    def at(self, number: int, stamp: int) -> None:
        """Set the time of what is put next: the event's number, and its stamp (ns)."""
        self.stream.set_time("event", sequence=number)
        self.stream.set_time("run", duration=np.timedelta64(stamp, "ns"))

    def put(self, entity: str, *what: Any) -> None:
        """Log something at that time."""
        self.stream.log(entity, *what)

    def static(self, entity: str, *what: Any) -> None:
        """Log what holds for the whole run."""
        self.stream.log(entity, *what, static=True)

    def columns(self, entity: str, events: Sequence[Numbered[E]], columns: Iterable[Any]) -> None:
        """Log rows at once, one for each event."""
        stamps = np.array([event.stamp for _, event in events], "timedelta64[ns]")
        numbers = np.array([number for number, _ in events], np.int64)
        self.stream.send_columns(
            entity,
            indexes=[
                self.rr.TimeColumn("event", sequence=numbers),
                self.rr.TimeColumn("run", duration=stamps),
            ],
            columns=columns,
        )
