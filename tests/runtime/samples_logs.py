"""A handler that keeps what is logged."""

from __future__ import annotations

import logging


class Lines(logging.Handler):
    """Handler that keeps the records, and their messages."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)
        self.messages.append(record.getMessage())
