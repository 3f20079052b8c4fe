"""The last records of a run's log, for snapshots."""

from __future__ import annotations

import collections
import itertools
import logging

from runtime.tools.monitor.snapshot import LogLine

KEPT = 100


class LastRecords(logging.Handler):
    """A handler that keeps the last records; runs in the log's own thread."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: collections.deque[LogLine] = collections.deque(maxlen=KEPT)
        self._numbers = itertools.count()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self._lines.append(
            LogLine(
                number=next(self._numbers),
                seconds=getattr(record, "seconds", 0.0),
                level=record.levelname,
                logger_name=getattr(record, "logger_name", record.name),
                text=record.getMessage(),
            )
        )

    def lines(self) -> list[LogLine]:
        """Return the records, the oldest first."""
        return list(self._lines)
