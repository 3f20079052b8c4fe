"""Outcomes of the frames sent to an outside system: counts, times, digest.

All that differs from run to run is in here, and nothing of it enters the run's digest.
"""

from __future__ import annotations

import bisect
import csv
import math
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec
import xxhash

from runtime.channels.wire import combined, fingerprint
from runtime.errors import ConfigError
from runtime.source_files import source_file
from runtime.time.clock import SECOND
from runtime.workers.costs import Costs

Outcome = Literal["answered", "empty", "initialising", "skipped", "lost"]
"""Outcome of a frame: answered; answered without content; still initialising, as the system
says, or without an answer yet; skipped, by a later answer; lost, without an answer in time.
"""

Wrong = Literal["late", "repeated", "contradicting", "unknown"]
"""Answers without a waiting frame: late, repeated, contradicting the first, or to no frame."""

COLUMNS = ("stamp_ns", "outcome", "latency_ms")
FOLDER = "answers"


class Settled(msgspec.Struct, frozen=True, gc=False):
    """A frame whose outcome is known.

    Attributes:
        latency: Real seconds that its answer took.
        digest: Of its answer; `None` if it is known only that there is none.
        says_lost: Whether the answer reports lost tracking.
    """

    stamp: int
    due: int
    outcome: Outcome
    latency: float = math.nan
    digest: int | None = None
    says_lost: bool = False


class Answers:
    """Record of an outside system through all its lives in a run; for any thread.

    Attributes:
        counts: Frames by `Outcome`, and wrong answers by `Wrong`.
        received: Frames of which the system has confirmed that it has them; `None` if it has no way
            to say so.
        latency: Seconds declared from a frame to its answer; `None` if they vary.
        why_not: Why an equal run might differ, whatever the system's own answers do.
        costs: Cost of its answers, if its processes are known.
    """

    def __init__(self, latency: float | None = 0.0, lost_allowed: int = 0) -> None:
        self.latency = latency
        self.lost_allowed = lost_allowed
        self.counts: Counter[str] = Counter()
        self.sent = 0
        self.received: int | None = None
        self.why_not: dict[str, None] = {}
        self.costs = Costs()
        self._lock = threading.Lock()
        self._settled: list[Settled] = []
        self._first: int | None = None
        self._initialised: int | None = None
        self._inputs: dict[str, xxhash.xxh3_128] = {}

    def owed(self, stamp: int) -> None:
        """Record an outgoing frame."""
        with self._lock:
            self.sent += 1
            if self._first is None:
                self._first = stamp

    @property
    def says_lost(self) -> int:
        """Number of answers reporting lost tracking."""
        return sum(frame.says_lost for frame in self._settled)

    def settled(self, frame: Settled) -> None:
        """Record the outcome of a frame."""
        with self._lock:
            self.counts[frame.outcome] += 1
            self._settled.append(frame)
            if frame.outcome == "answered" and self._initialised is None:
                self._initialised = frame.stamp

    def end(self, now: int) -> None:
        """Forget the outcomes of frames not due by now (ns): they are up to real time."""
        with self._lock:
            self.counts -= Counter(frame.outcome for frame in self._settled if frame.due > now)
            self._settled = [frame for frame in self._settled if frame.due <= now]

    def wrong(self, kind: Wrong) -> None:
        """Count an answer without a waiting frame."""
        with self._lock:
            self.counts[kind] += 1

    def count_received(self, count: int = 1) -> None:
        """Count frames confirmed by the system as received."""
        with self._lock:
            self.received = (self.received or 0) + count

    def record_input(self, stream: str, data: bytes | bytearray | memoryview) -> None:
        """Add data sent to the system to the digest of its inputs.

        Args:
            stream: Topic, or kind of data: the order counts within each.
            data: The bytes, without anything that differs from run to run.
        """
        content = memoryview(data).cast("B")
        with self._lock:
            digest = self._inputs.get(stream)
            if digest is None:
                digest = self._inputs[stream] = xxhash.xxh3_128()
            digest.update(content.nbytes.to_bytes(8, "little"))
            digest.update(content)

    @property
    def initialisation(self) -> float | None:
        """Seconds from the first frame to the first answered; `None` without answers."""
        if self._first is None or self._initialised is None:
            return None
        return (self._initialised - self._first) / SECOND

    def inputs(self) -> str | None:
        """Return the digest of all data sent to the system; `None` if there was none."""
        with self._lock:
            digests = {name: digest.hexdigest() for name, digest in self._inputs.items()}
        return combined(digests) if digests else None

    def outputs(self) -> str | None:
        """Return the digest of all answers, by their frames' stamps; `None` if there were none."""
        with self._lock:
            rows = sorted((row.stamp, row.outcome, row.digest or 0) for row in self._settled)
        return f"{fingerprint(rows):016x}" if rows else None

    def latency_quantiles(self, *quantiles: float) -> list[float | None]:
        """Return quantiles of the real seconds to an answer; `None` without answers."""
        known = sorted(s.latency for s in self._settled if not math.isnan(s.latency))
        return [
            known[min(int(q * len(known)), len(known) - 1)] if known else None for q in quantiles
        ]

    def write(self, folder: Path, name: str) -> None:
        """Write a row for each frame to ``answers/<name>.csv``, for replay in another run."""
        (folder / FOLDER).mkdir(exist_ok=True)
        file = folder / FOLDER / f"{source_file(name)}.csv"
        with file.open("w", newline="", encoding="utf-8") as out:
            rows = csv.writer(out)
            rows.writerow(COLUMNS)
            for frame in self._settled:
                known = "" if math.isnan(frame.latency) else f"{frame.latency * 1e3:.6f}"
                rows.writerow((frame.stamp, frame.outcome, known))


def read_latencies(path: Path, factor: float = 1.0) -> Callable[[int], float]:
    """Return the measured latencies (s) of a run by a frame's stamp (ns): the last answered one's.

    Args:
        path: An ``answers/<name>.csv``; before its first answered frame, that one's counts.
        factor: Multiplies each: how much slower the intended machine is.

    Raises:
        ConfigError: The file cannot be read, or is none; the message says where.
    """
    stamps: list[int] = []
    seconds: list[float] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(file)
            if (head := next(rows, [])) != list(COLUMNS):
                raise ValueError(f"expected columns {','.join(COLUMNS)}, found {','.join(head)!r}")
            for line, row in enumerate(rows, 2):
                try:
                    stamp, _, latency = row
                    if latency:
                        stamps.append(int(stamp))
                        seconds.append(factor * float(latency) / 1e3)
                except ValueError as error:
                    raise ValueError(f"line {line}: {error}") from None
                if latency and not 0 <= seconds[-1] < math.inf:
                    raise ValueError(f"line {line}: expected a latency ≥ 0, found {latency}")
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise ConfigError(
            f"latencies: {path}: expected measured latencies, found: {error}"
        ) from None
    if not stamps:
        raise ConfigError(f"latencies: {path}: expected at least one answered frame, found none")
    order = sorted(range(len(stamps)), key=stamps.__getitem__)  # answers may overtake each other
    stamps, seconds = [stamps[n] for n in order], [seconds[n] for n in order]

    def latency_at(stamp: int) -> float:
        return seconds[max(bisect.bisect_right(stamps, stamp) - 1, 0)]

    return latency_at
