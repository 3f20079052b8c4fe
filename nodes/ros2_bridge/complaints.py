"""What went wrong outside: counted always, told seldom."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

TOLD_EVERY = 5.0
"""Real seconds."""


class Complaints:
    """Counts of what went wrong, by topic and kind; may be told from any thread.

    Args:
        say: Takes a line for the log.
        now: Real seconds.
    """

    def __init__(
        self, say: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._say = say
        self._now = now
        self._told: dict[tuple[str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def add(self, where: str, kind: str, detail: str = "") -> None:
        """Count something; say so if nothing like it was said for `TOLD_EVERY`.

        Args:
            where: Topic.
            kind: Of trouble, in few words; there are only a few.
            detail: What exactly, this time.
        """
        with self._lock:
            key, now = (where, kind), self._now()
            self.counts[key] += 1
            when, before = self._told.get(key, (-TOLD_EVERY, 0))
            if now - when < TOLD_EVERY:
                return
            count = self.counts[key]
            self._told[key] = (now, count)
            since = count - before
        times = f" ({since} times since the last such line)" if since > 1 else ""
        self._say(f"{where}: {kind}{': ' if detail else ''}{detail:.300}{times}")
