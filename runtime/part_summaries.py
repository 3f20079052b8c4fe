"""What a run reports of its parts: tickers, inputs, links, workers, and systems outside."""

from __future__ import annotations

from typing import Any, get_args

import msgspec

from runtime.answers import Answers, Outcome, Wrong
from runtime.workers.costs import Costs


class TickSummary(msgspec.Struct, frozen=True):
    """How punctual one ticker was; microseconds of the run's clock."""

    hz: float
    calls: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    missed: int


class StreamSummary(msgspec.Struct, frozen=True):
    """How full one input got, and what it dropped.

    For a bundle, `missed` says how often a set did not come about, by the field that was missing.
    """

    bound: int
    peak: int
    dropped: int
    missed: dict[str, int] = {}


class LinkSummary(msgspec.Struct, frozen=True):
    """How many events a link lost, and how many it left out to keep to its rate."""

    lost: int
    thinned: int


class WorkerSummary(msgspec.Struct, frozen=True):
    """What the calls of a worker cost this machine.

    Attributes:
        latency_ms: That the file declares, on the run's clock; `None` if it differs by call.
        calls: That were answered.
        wall_p50_ms: Real time of a call in the worker's process: median.
        wall_p95_ms: 95th percentile.
        wall_max_ms: Longest.
        cpu_p50_ms: Processor time of all threads of that process from one call's end to the
            next one's: median.
        cpu_p95_ms: 95th percentile.
        cpu_max_ms: Most.
        peak_rss_mb: Most memory that one of the processes has had; `None` if unknown.
        processes: How many there were at once.
    """

    latency_ms: float | None
    calls: int
    wall_p50_ms: float
    wall_p95_ms: float
    wall_max_ms: float
    cpu_p50_ms: float
    cpu_p95_ms: float
    cpu_max_ms: float
    peak_rss_mb: float | None
    processes: int

    @classmethod
    def of(cls, costs: Costs) -> WorkerSummary:
        """Sum up what there is."""
        return cls(
            latency_ms=None if costs.latency is None else round(costs.latency * 1e3, 6),
            calls=costs.calls,
            wall_p50_ms=costs.wall.quantile(0.5) / 1e6,
            wall_p95_ms=costs.wall.quantile(0.95) / 1e6,
            wall_max_ms=costs.wall.maximum / 1e6,
            cpu_p50_ms=costs.cpu.quantile(0.5) / 1e6,
            cpu_p95_ms=costs.cpu.quantile(0.95) / 1e6,
            cpu_max_ms=costs.cpu.maximum / 1e6,
            peak_rss_mb=costs.peak / 1e6 or None,
            processes=costs.processes,
        )

    def row(self) -> list[str]:
        """Return it as a table shows it, under `WORKER_COLUMNS`."""
        wall = (self.wall_p50_ms, self.wall_p95_ms, self.wall_max_ms)
        cpu = (self.cpu_p50_ms, self.cpu_p95_ms, self.cpu_max_ms)
        return [
            "varies" if self.latency_ms is None else f"{self.latency_ms:g}",
            f"{self.calls}",
            *(f"{each:.3g}" if each < 100 else f"{each:.0f}" for each in wall + cpu),
            "" if self.peak_rss_mb is None else f"{self.peak_rss_mb:.0f}",
            f"{self.processes}",
        ]


WORKER_COLUMNS = (
    *("latency ms", "calls", "real p50 ms", "p95 ms", "max ms"),
    *("CPU p50 ms", "p95 ms", "max ms", "peak MB", "processes"),
)


class OutsideSummary(msgspec.Struct, frozen=True):
    """How a system outside the process answered what it was sent.

    Attributes:
        latency_ms: Declared, on the run's clock; `None` if it differs by frame.
        sent: Frames that went out.
        received: Frames that the system confirmed; `None` if it cannot say.
        answered: Frames with an answer.
        says_lost: Answers that say that tracking is lost, among those and the empty ones.
        empty: Frames with an answer that held nothing, such as no pose.
        initialising: Frames for which the system was still initialising: it said so, or had not
            yet answered any, as was allowed.
        skipped: Frames that the system left out, as a later answer says.
        lost: Frames for which none came in time.
        open: Frames on their way when the run ended. `sent` is the sum of `answered`, `empty`,
            `initialising`, `skipped`, `lost` and `open`.
        late: Answers to frames that were given up.
        repeated: Second answers to a frame that say the same.
        contradicting: Second answers to a frame that say something else.
        unknown: Answers whose stamp is no frame's.
        initialisation_s: From the first frame to the first that was answered.
        wall_p50_ms: Real time from a frame to its answer: median.
        wall_p99_ms: 99th percentile.
        inputs: Digest of all that the system was sent; equal if it got the same.
        answers: Digest of all that it answered, each to its frame.
        reproducible: Whether an equal run gives the same, if the system answers the same.
        why_not: Why it may not.
        repeats: Whether it has answered the same when run twice (``run --twice``); `None` if that
            is unknown.
    """

    latency_ms: float | None
    sent: int
    received: int | None
    answered: int
    empty: int
    initialising: int
    skipped: int
    lost: int
    open: int
    late: int
    repeated: int
    unknown: int
    initialisation_s: float | None
    wall_p50_ms: float | None
    wall_p99_ms: float | None
    inputs: str | None
    reproducible: bool
    why_not: list[str]
    says_lost: int = 0
    contradicting: int = 0
    answers: str | None = None
    repeats: bool | None = None

    @classmethod
    def of(cls, answers: Answers) -> OutsideSummary:
        """Sum up what there is."""
        counts: dict[str, Any] = {
            name: answers.counts[name] for name in (*get_args(Outcome), *get_args(Wrong))
        }
        p50, p99 = answers.latency_quantiles(0.5, 0.99)
        return cls(
            latency_ms=None if answers.latency is None else round(answers.latency * 1e3, 6),
            sent=answers.sent,
            received=answers.received,
            says_lost=answers.says_lost,
            open=answers.sent - sum(counts[name] for name in get_args(Outcome)),
            initialisation_s=answers.initialisation,
            wall_p50_ms=None if p50 is None else p50 * 1e3,
            wall_p99_ms=None if p99 is None else p99 * 1e3,
            inputs=answers.inputs(),
            answers=answers.outputs(),
            reproducible=not answers.why_not,
            why_not=list(answers.why_not),
            **counts,
        )

    def row(self) -> list[str]:
        """Return it as a table shows it, under `OUTSIDE_COLUMNS`."""
        return [
            *(f"{self.sent}", "–" if self.received is None else f"{self.received}"),
            *(str(each) for each in (self.answered, self.empty, self.initialising, self.skipped)),
            *(str(each) for each in (self.lost, self.open, self.says_lost, self.late)),
            *(str(each) for each in (self.repeated, self.contradicting, self.unknown)),
            *(
                "–" if each is None else f"{each:.3g}"
                for each in (self.initialisation_s, self.latency_ms, self.wall_p50_ms)
            ),
            "yes" if self.reproducible else f"no: {'; '.join(self.why_not)}",
            {True: "yes", False: "no", None: "unknown until run --twice"}[self.repeats],
        ]


class TwiceSummary(msgspec.Struct, frozen=True):
    """How a run compares with an equal one before; see `runtime.tools.twice`.

    Attributes:
        repeats: Whether all was the same.
        first: Who differed first, the rig or a system outside, when, and by how much.
        outputs: Those whose events differed.
    """

    repeats: bool
    first: str = ""
    outputs: list[str] = []


OUTSIDE_COLUMNS = (
    *("sent", "received", "answered", "empty", "initialising", "skipped"),
    *("no answer", "open", "says lost", "late", "repeated", "contradicting", "of no frame"),
    *("initialised s", "latency ms", "real p50 ms", "inputs repeat", "answers repeat"),
)
