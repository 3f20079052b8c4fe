"""What clients do and are refused: counted, and logged without flooding the log."""

from __future__ import annotations

import re
from collections import Counter

from runtime.logs import NodeLogger

MOST_WARNINGS = 500
"""Different refusals that are logged as warnings; all others are at debug level."""


class Incidents:
    """Counts and logs what happens on all connections."""

    def __init__(self, log: NodeLogger) -> None:
        self._log = log
        self._counts: Counter[str] = Counter()
        self._logged: set[tuple[str, str]] = set()

    def count(self, what: str) -> None:
        """Count something."""
        self._counts[what] += 1

    def refused(self, address: str, text: str) -> None:
        """Log what a client was refused, once for each host and kind: texts equal but for numbers.

        Scripts do not see the errors of calls that they do not join, so the log must tell them.
        """
        self._counts["refused"] += 1
        key = address.rpartition(":")[0], re.sub(r"[\d.]+", "#", text)
        is_new = key not in self._logged and len(self._logged) < MOST_WARNINGS
        if is_new:
            self._logged.add(key)
        text = text if text.isprintable() else ascii(text)
        (self._log.warning if is_new else self._log.debug)("%s: refused: %.400s", address, text)

    def failed(self, method: str, error: BaseException) -> None:
        """Log an error that is the server's own, once for each method."""
        self._counts["failed"] += 1
        if ("", method) not in self._logged:
            self._logged.add(("", method))
            self._log.error("%s failed, which is a bug of the server", method, exc_info=error)

    def log_counts(self) -> None:
        """Log how often each thing happened."""
        if self._counts:
            counts = (f"{count} {what}" for what, count in self._counts.items())
            self._log.info("AirSim's clients: %s", ", ".join(counts))
