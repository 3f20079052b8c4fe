"""What is wrong with messages from outside: it is always counted, and seldom logged."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

LOG_INTERVAL = 5.0
"""Real seconds between two log lines about the same."""


class Complaints:
    """Counts of what went wrong, by topic and kind. For any thread.

    Args:
        log: Takes a line for the log.
        now: Real seconds.
    """

    def __init__(
        self, log: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._log = log
        self._now = now
        self._logged: dict[tuple[str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def add(self, where: str, kind: str, detail: str = "") -> None:
        """Count something; log it if nothing like it was logged for `LOG_INTERVAL`.

        Args:
            where: Topic.
            kind: Of trouble, in few words; there are only a few.
            detail: What exactly, this time.
        """
        with self._lock:
            key, now = (where, kind), self._now()
            self.counts[key] += 1
            when, before = self._logged.get(key, (-LOG_INTERVAL, 0))
            if now - when < LOG_INTERVAL:
                return
            count = self.counts[key]
            self._logged[key] = (now, count)
            since = count - before
        times = f" ({since} times since the last such line)" if since > 1 else ""
        self._log(f"{where}: {kind}{': ' if detail else ''}{detail:.300}{times}")
