"""Holds simulated time for the answers of a system outside the process.

    self.slam = self.hold("slam", self.config.hold, self.config.latency)

    owed = self.slam.owe(image.stamp)      # before it is sent; time goes no further than its due
    await self.offload(send, image)
    pose = await owed                      # exactly `latency` later on the clock, or None

The answer comes from any thread, as `Hold.answer`. Up to its due, time runs on: with 40 ms the
vehicle goes on flying while an estimator works, and at most ``latency × rate`` frames, rounded
up, are on their way. What came when in real time decides nothing, so the run's digest depends on
what the answers hold only. Whatever breaks that promise (`Answers.why_not`) is reported.

The latency counts from the instant at which the frame goes out, as that of a worker's call does:
the same estimator has the same digest as a worker and as a process of its own.

In real time nothing is held: answers come when they come, no earlier than their latency, and an
answer to a later frame says that those before it were skipped.
"""

from __future__ import annotations

import concurrent.futures
import threading
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import msgspec

from runtime.channels.answers import Answers, Outcome, Settled, Wrong, read_latencies
from runtime.channels.wire import fingerprint
from runtime.errors import MissingAnswerError
from runtime.paths import InputPath
from runtime.time.clock import SECOND, Clock, result_of
from runtime.units import Duration

T = TypeVar("T")
V = TypeVar("V")


class Owed(Generic[T]):
    """The answer to a frame, awaitable once: its content, or `None` if there is none.

    Raises:
        MissingAnswerError: There is none, and by `HoldConfig.on_missing` that is an error.
    """

    __slots__ = ("_clock", "due", "later", "since", "stamp", "work")

    def __init__(self, clock: Clock, stamp: int, due: int, since: float) -> None:
        self._clock = clock
        self.stamp = stamp
        self.due = due
        self.since = since  # real seconds
        self.work = future()
        self.later: concurrent.futures.Future[Any] | None = None
        """Future of the answer, if the clock was released without."""

    @property
    def pending(self) -> concurrent.futures.Future[Any]:
        """Future that gets the answer."""
        return self.work if self.later is None else self.later

    def __await__(self) -> Generator[Any, None, T | None]:
        return self._answer().__await__()

    async def _answer(self) -> T | None:
        latency = max(self.due - self._clock.now(), 0)
        answer: T | None = await self._clock.beside(self.work, latency)
        return answer if self.later is None else await result_of(self.later)


def future() -> concurrent.futures.Future[Any]:
    """Return a future unaffected by the cancellation of its reader."""
    made: concurrent.futures.Future[Any] = concurrent.futures.Future()
    made.set_running_or_notify_cancel()
    return made


BEHIND = 2.0
"""Most lag of simulated time behind real time while a system initialises, in real seconds."""

IN_A_ROW = 3
"""Frames lost in a row for a system to count as hung, not waited for until its next answer."""

_LOOK = 0.02  # real seconds between two checks for overdue answers
_REMEMBERED = 4096  # settled frames remembered by stamp, to recognise answers to them


class HoldConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings for holding simulated time until an outside system answers.

    Attributes:
        skips: ``refused``: each frame is answered, in any order. ``allowed``: an answer to a later
            frame means that none will come for the frames before it.
        initialise: Start-up time from the first frame: no answer is owed before the system's
            first; until then simulated time goes no faster than real time.
        max_wait: Real seconds without any answer after which an answer counts as missing.
        on_missing: Reaction to a missing answer or a lost system. ``error``: the run ends.
            ``lost``: the frame is lost, counted, and shown in the verdict. ``continue``: the run
            goes on without waiting, and is marked as not reproducible.
        lost_allowed: Number of frames that may be lost with the verdict still passed.
        tolerance_ns: Greatest difference between the stamps of answer and frame: stamps that went
            through a double are not exact.
        latencies: ``answers/<name>.csv`` of a run in real time; its measured latencies replace the
            declared one.
        latency_factor: Multiplies those, for a slower or quicker machine.
    """

    skips: Literal["refused", "allowed"] = "refused"
    initialise: Duration = Duration(0.0)  # immutable
    max_wait: Duration = Duration(10.0)  # immutable
    on_missing: Literal["error", "lost", "continue"] = "error"
    lost_allowed: Annotated[int, msgspec.Meta(ge=0)] = 0
    tolerance_ns: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 1000
    latencies: InputPath = ""
    latency_factor: Annotated[float, msgspec.Meta(gt=0)] = 1.0


class Hold(Generic[T]):
    """Ledger of the frames sent to an outside system: which of them it owes an answer.

    A frame is owed until it is settled by one of these: an answer, an answer to a later frame if
    `skips`, too long a silence, the loss of the system. What comes for a settled frame is counted.

    Attributes:
        skips: Whether an answer means that none will come for the frames before it.

    Args:
        latency: Seconds of the run's clock from a frame to its answer.
        log: Called with lines for the run's log, in any thread.
        wall: Returns real seconds, without those in which the run is paused.

    Raises:
        ConfigError: There are no latencies in the file that `config` names.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        config: HoldConfig,
        latency: float,
        *,
        answers: Answers | None = None,
        log: Callable[[str], None] = lambda _: None,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self.config = config
        self.answers = Answers() if answers is None else answers
        self._latency_at: Callable[[int], float] = lambda _: latency
        self.answers.latency = latency
        self.answers.lost_allowed = config.lost_allowed
        if config.latencies:
            self._latency_at = read_latencies(Path(config.latencies), config.latency_factor)
            self.answers.latency = None
        self.answers.costs.latency = self.answers.latency
        self._clock = clock
        self._log = log
        self._wall = wall
        self.skips = config.skips == "allowed" or clock.kind == "real"
        if clock.kind == "real":
            self.answers.why_not["the clock is real"] = None
        self._lock = threading.RLock()
        self._owed: dict[int, Owed[T]] = {}  # by stamp, in the order of sending
        self._settled: dict[int, Settled] = {}  # by stamp
        self._last: tuple[int, int] | None = None  # stamp and due of the newest frame
        self._began: tuple[int, float] | None = None  # stamp and real time of the first frame
        self._last_answer: float | None = None  # real time of it, or of the last lost frame
        self._in_a_row = 0
        self._released = False  # whether time runs on without answers
        self._gone = ""
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()

    # On the loop.

    @property
    def newest(self) -> int:
        """Stamp of the newest frame (ns); -1 without any."""
        return -1 if self._last is None else self._last[0]

    def owe(self, stamp: int) -> Owed[T]:
        """Register an outgoing frame by its stamp (ns), and return its pending answer.

        Raises:
            ValueError: The stamp is not greater than that of the frame before.
            MissingAnswerError: The system is gone, or hangs, and by the settings that is an error.
        """
        with self._lock:
            if self._error is not None:
                raise self._error
            if self._last is not None and stamp <= self._last[0]:
                raise ValueError(
                    f"{self.name}: expected a frame after {_seconds(self._last[0])}, "
                    f"found one of {_seconds(stamp)}"
                )
            # In the order of the frames, whatever latencies were measured.
            due = self._clock.now() + round(self._latency_at(stamp) * SECOND)
            due = max(due, self._last[1] if self._last else 0)
            self._last = stamp, due
            owed: Owed[T] = Owed(self._clock, stamp, due, self._wall())
            if self._began is None:
                self._began = stamp, owed.since
            self.answers.owed(stamp)
            self._owed[stamp] = owed
            if not self.expects:
                self._settle(owed, "lost")
            elif self._released:
                self._release(owed)
            if self._thread is None:
                self._thread = threading.Thread(target=self._watch, name=self.name, daemon=True)
                self._thread.start()
            return owed

    @property
    def expects(self) -> bool:
        """Whether answers are expected; if not, frames are lost and need no sending."""
        return not (self._gone or (self._released and self.config.on_missing == "lost"))

    # In any thread.

    def waited(self, stamp: int) -> float | None:
        """Return for how many real seconds a frame is owed an answer; `None` if it is owed none."""
        with self._lock:
            owed = self._owed.get(stamp)
            return None if owed is None else self._wall() - owed.since

    def sent(self, stream: str, data: bytes | bytearray | memoryview) -> None:
        """Add data sent to the system to the digest of its inputs; see `Answers.record_input`."""
        self.answers.record_input(stream, data)

    def received(self, count: int = 1) -> None:
        """Count frames confirmed by the system as received."""
        self.answers.count_received(count)

    def answer(
        self, stamp: int, value: T | None, says: Literal["", "initialising", "lost"] = ""
    ) -> None:
        """Record the answer to the frame of a stamp (ns); `None` if no more is to come for it.

        Args:
            says: What it says of the system: nothing, that it still initialises, or has lost track.
        """
        digest = None if says == "initialising" else fingerprint(value)  # no answer yet
        with self._lock:
            if self._closed.is_set():
                return
            now = self._wall()
            owed = _nearest(stamp, self._owed, self.config.tolerance_ns)
            if owed is None:
                self._record_unawaited(stamp, value, digest)
            else:
                for earlier in [frame for frame in self._owed.values() if frame.stamp < owed.stamp]:
                    if self._initialising(earlier.stamp):
                        self._settle(earlier, "initialising")
                    elif self.skips:
                        self._settle(earlier, "skipped")
                outcome: Outcome = "empty" if value is None else "answered"
                if says == "initialising":
                    outcome, value = "initialising", None
                self._settle(owed, outcome, value, now - owed.since, digest, says == "lost")
            if self._released:
                self._log(f"{self.name}: it answers again")
            self._last_answer, self._released, self._in_a_row = now, False, 0

    def gone(self, why: str) -> None:
        """Report the loss of the system, effective at once."""
        with self._lock:
            if self._closed.is_set() or self._gone:
                return
            self._gone = why
            if self.config.on_missing == "error":
                separator = "\n" if "\n" in why else " "  # a program's last lines
                self._fail(MissingAnswerError(f"{self.name}: {why}{separator}({self._story()})"))
                return
            self._log(f"{self.name}: {why}")
            if self.config.on_missing == "continue":
                self._not_reproducible("it was gone for a while")
            self._lose_all()

    def back(self) -> None:
        """Report the system as back, if it was gone; the system may initialise anew."""
        with self._lock:
            if not self._gone:
                return
            self._log(f"{self.name}: it is there again")
            self._not_reproducible("when it came back was up to real time")
            self._gone, self._released, self._in_a_row = "", False, 0
            self._began = self._last_answer = None

    def fail(self, error: Exception) -> None:
        """Raise an error in all tasks that await an answer, and with the next frame."""
        with self._lock:
            self._fail(error)

    def doubt(self, why: str) -> None:
        """Record and log why an equal run might differ."""
        if why not in self.answers.why_not:
            self._log(f"{self.name}: an equal run may differ: {why}")
        self._not_reproducible(why)

    def close(self) -> None:
        """Stop watching and taking answers; outstanding answers stay owed."""
        with self._lock:
            if not self._closed.is_set():
                self._closed.set()
                self.answers.end(self._clock.now())

    def look(self) -> None:
        """Give up on overdue answers; called repeatedly by a thread."""
        with self._lock:
            now = self._wall()
            while self._owed:
                oldest = next(iter(self._owed.values()))
                if oldest.later is not None:  # nobody waits for it
                    return
                if self._initialising(oldest.stamp):
                    if now < self._real_time(oldest) + BEHIND:
                        return
                    self._settle(oldest, "initialising")
                elif now < max(oldest.since, self._last_answer or 0.0) + self.config.max_wait:
                    return
                else:
                    self._give_up(oldest)

    # With the lock.

    def _initialising(self, stamp: int) -> bool:
        if self._last_answer is not None or self._began is None:
            return False
        return stamp - self._began[0] < self.config.initialise * SECOND

    def _real_time(self, owed: Owed[T]) -> float:
        """Return when an answer would be due, had time been real since the first frame."""
        assert self._began is not None
        stamp, since = self._began
        return since + (owed.stamp - stamp) / SECOND + self._latency_at(owed.stamp)

    def _record_unawaited(self, stamp: int, value: T | None, digest: int | None) -> None:
        """Count an answer to a frame that is settled already, or to none."""
        settled = _nearest(stamp, self._settled, self.config.tolerance_ns)
        kind: Wrong = "unknown" if settled is None else "late"
        if settled is not None and settled.digest is not None:
            same = value is None or digest == settled.digest  # no more to come, or the same
            kind = "repeated" if same else "contradicting"
        self.answers.wrong(kind)
        if kind == "contradicting":
            if self.answers.counts["contradicting"] == 1:
                self._log(
                    f"{self.name}: expected one answer to the frame of {_seconds(stamp)}, found a "
                    "second one that differs (two that answer?): the first one counts"
                )
            self._not_reproducible("frames were answered twice, differently")
        elif settled is not None and settled.outcome == "initialising":
            self.doubt("its first answer came too late to be held for")

    def _settle(
        self, owed: Owed[T], outcome: Outcome, value: T | None = None, *answer: Any
    ) -> None:
        """Settle a frame; `answer` holds the further fields of `Settled`."""
        del self._owed[owed.stamp]
        settled = Settled(owed.stamp, owed.due, outcome, *answer)
        self._settled[owed.stamp] = settled
        while len(self._settled) > _REMEMBERED:
            del self._settled[next(iter(self._settled))]
        self.answers.settled(settled)
        owed.pending.set_result(value)

    def _release(self, owed: Owed[T]) -> None:
        """Release the clock from a frame; its answer may still come."""
        owed.later = future()
        owed.work.set_result(None)

    def _give_up(self, owed: Owed[T]) -> None:
        missing = (
            f"expected an answer to the frame of {_seconds(owed.stamp)} within "
            f"{self.config.max_wait:g} s (max_wait), found none"
        )
        if self.config.on_missing == "error":
            self._fail(MissingAnswerError(f"{self.name}: {missing} ({self._story()})"))
            return
        if self.config.on_missing == "continue":
            self._released = True
            self._log(f"{self.name}: {missing}; the run goes on without")
            self._not_reproducible("the run went on without an answer")
            for frame in self._owed.values():
                if frame.later is None:
                    self._release(frame)
            return
        self._log(f"{self.name}: {missing}: the frame is lost")
        self._not_reproducible(f"frames were lost after {self.config.max_wait:g} s of real time")
        self._last_answer = self._wall()
        self._in_a_row += 1
        self._settle(owed, "lost")
        if self._in_a_row >= IN_A_ROW:
            self._released = True
            self._log(
                f"{self.name}: {IN_A_ROW} frames in a row are lost: it is not waited for again "
                "before it answers"
            )
            self._lose_all()

    def _lose_all(self) -> None:
        for owed in list(self._owed.values()):
            self._settle(owed, "lost")

    def _fail(self, error: Exception) -> None:
        if self._error is not None or self._closed.is_set():
            return
        self._error = error
        for owed in self._owed.values():
            owed.pending.set_exception(error)
        self._owed.clear()

    def _not_reproducible(self, why: str) -> None:
        self.answers.why_not[why] = None

    def _story(self) -> str:
        counts = self.answers.counts
        return (
            f"{self.answers.sent} frames sent, {counts['answered']} answered, "
            f"{counts['unknown']} answers of no frame"
        )

    def _watch(self) -> None:
        while not self._closed.wait(_LOOK):
            self.look()


def _nearest(stamp: int, frames: Mapping[int, V], tolerance: int) -> V | None:
    """Return the frame whose stamp is nearest to another, if within the tolerance."""
    if stamp in frames:
        return frames[stamp]
    near = min(frames, key=lambda known: abs(known - stamp), default=None)
    return None if near is None or abs(near - stamp) > tolerance else frames[near]


def _seconds(stamp: int) -> str:
    return f"{stamp / SECOND:.6f} s"
