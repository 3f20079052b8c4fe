"""``summary.json``: the report of a run and of its parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, get_args

import msgspec

from runtime.channels.wire import combined

if TYPE_CHECKING:
    from runtime.channels.answers import Answers
    from runtime.workers.costs import Costs


class Stall(msgspec.Struct, frozen=True):
    """A period without a turn of the loop.

    Attributes:
        node: The node that ran, or ``runtime``.
        line: ``file:line in function``, the innermost line of the node.
        seconds: How long, in real time.
    """

    node: str
    line: str
    seconds: float


class TickSummary(msgspec.Struct, frozen=True):
    """Punctuality of a ticker, in microseconds of the run's clock."""

    hz: float
    calls: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    missed: int


class StreamSummary(msgspec.Struct, frozen=True):
    """Bound, peak and drops of an input.

    For a bundle, `missed` counts incomplete sets, by the missing field.
    """

    bound: int
    peak: int
    dropped: int
    missed: dict[str, int] = {}


class LinkSummary(msgspec.Struct, frozen=True):
    """Events lost by a link, and events left out to keep to its rate."""

    lost: int
    thinned: int


SLOWER = 1.5  # ratio of measured to declared latency of a worker to be warned of, medians


class WorkerSummary(msgspec.Struct, frozen=True):
    """Cost of a worker's calls on this machine.

    Attributes:
        latency_ms: As the file declares, on the run's clock; `None` if it differs by call.
        wall_p50_ms: Real time of a call in the worker's process: median.
        cpu_p50_ms: Processor time of all threads of that process from one call's end to the next
            one's: median.
        peak_rss_mb: Peak memory of any of the processes; `None` if unknown.
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
        """Return the summary of a worker's costs."""
        return cls(
            latency_ms=None if costs.latency is None else round(costs.latency * 1e3, 6),
            calls=costs.calls, wall_p50_ms=costs.wall.quantile(0.5) / 1e6,
            wall_p95_ms=costs.wall.quantile(0.95) / 1e6, wall_max_ms=costs.wall.maximum / 1e6,
            cpu_p50_ms=costs.cpu.quantile(0.5) / 1e6, cpu_p95_ms=costs.cpu.quantile(0.95) / 1e6,
            cpu_max_ms=costs.cpu.maximum / 1e6, peak_rss_mb=costs.peak / 1e6 or None,
            processes=costs.processes,
        )  # fmt: skip

    @property
    def slower(self) -> str:
        """Sentence if calls take longer than declared, "" if not; by the medians, `SLOWER`."""
        if not self.latency_ms or self.wall_p50_ms <= SLOWER * self.latency_ms:
            return ""
        return (
            f"each call takes {self.wall_p50_ms:.3g} ms here; declared are {self.latency_ms:.3g} "
            "ms: results are those of a quicker machine"
        )

    def row(self) -> list[str]:
        """Return the cells of a table row, under `WORKER_COLUMNS`."""
        wall = (self.wall_p50_ms, self.wall_p95_ms, self.wall_max_ms)
        cpu = (self.cpu_p50_ms, self.cpu_p95_ms, self.cpu_max_ms)
        return [
            "varies" if self.latency_ms is None else f"{self.latency_ms:g}",
            f"{self.calls}",
            *(f"{number:.3g}" if number < 100 else f"{number:.0f}" for number in wall + cpu),
            "" if self.peak_rss_mb is None else f"{self.peak_rss_mb:.0f}",
            f"{self.processes}",
        ]


WORKER_COLUMNS = (
    *("latency ms", "calls", "real p50 ms", "p95 ms", "max ms"),
    *("CPU p50 ms", "p95 ms", "max ms", "peak MB", "processes"),
)


class OutsideSummary(msgspec.Struct, frozen=True):
    """Answers of a system outside the process to its frames.

    Attributes:
        latency_ms: Declared, on the run's clock; `None` if it differs by frame.
        received: Frames that the system confirmed; `None` if it cannot say.
        says_lost: Answers that report lost tracking, among those and the empty ones.
        empty: Frames with an empty answer, such as no pose.
        initialising: Frames for which the system was still initialising: it said so, or had not yet
            answered any, as was allowed.
        skipped: Frames that the system left out, as a later answer says.
        open: Frames on their way when the run ended. `sent` is the sum of `answered`, `empty`,
            `initialising`, `skipped`, `lost` and `open`.
        late: Answers to frames that were given up.
        repeated: Second answers to a frame that say the same.
        contradicting: Second answers to a frame that say something else.
        unknown: Answers whose stamp is no frame's.
        initialisation_s: From the first frame to the first that was answered.
        wall_p50_ms: Real time from a frame to its answer: median.
        inputs: Digest of all that the system was sent; equal if it got the same.
        answers: Digest of all answers, each with its frame.
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
        """Return the summary of a system's answers."""
        from runtime.channels.answers import Outcome, Wrong  # only with such a system

        counts: dict[str, Any] = {
            name: answers.counts[name] for name in (*get_args(Outcome), *get_args(Wrong))
        }
        p50, p99 = answers.latency_quantiles(0.5, 0.99)
        return cls(
            latency_ms=None if answers.latency is None else round(answers.latency * 1e3, 6),
            sent=answers.sent, received=answers.received, says_lost=answers.says_lost,
            open=answers.sent - sum(counts[name] for name in get_args(Outcome)),
            initialisation_s=answers.initialisation, wall_p50_ms=None if p50 is None else p50 * 1e3,
            wall_p99_ms=None if p99 is None else p99 * 1e3, inputs=answers.inputs(),
            answers=answers.outputs(), reproducible=not answers.why_not,
            why_not=list(answers.why_not), **counts,
        )  # fmt: skip

    def row(self) -> list[str]:
        """Return the cells of a table row, under `OUTSIDE_COLUMNS`."""
        values = (getattr(self, field) for field in _OUTSIDE.values())
        figures = ("–" if value is None else value for value in values)
        return [
            *(f"{figure:.3g}" if isinstance(figure, float) else str(figure) for figure in figures),
            "yes" if self.reproducible else f"no: {'; '.join(self.why_not)}",
            {True: "yes", False: "no", None: "unknown until run --twice"}[self.repeats],
        ]


_OUTSIDE = {
    "sent": "sent", "received": "received", "answered": "answered", "empty": "empty",
    "initialising": "initialising", "skipped": "skipped", "no answer": "lost", "open": "open",
    "says lost": "says_lost", "late": "late", "repeated": "repeated",
    "contradicting": "contradicting", "of no frame": "unknown",
    "initialised s": "initialisation_s", "latency ms": "latency_ms", "real p50 ms": "wall_p50_ms",
}  # fmt: skip
"""Columns of figures, with the field of each."""

OUTSIDE_COLUMNS = (*_OUTSIDE, "inputs repeat", "answers repeat")


class TwiceSummary(msgspec.Struct, frozen=True):
    """Comparison of a run with an equal earlier run; see `runtime.tools.twice`.

    Attributes:
        first: Who differed first, the rig or a system outside, when, and by how much.
        outputs: Those whose events differed.
    """

    repeats: bool
    first: str = ""
    outputs: list[str] = []


class Verdict(msgspec.Struct, frozen=True):
    """How those did whom the run was about.

    Attributes:
        passed: Whether all met their thresholds; `None` if none failed and one was not judged.
        estimators: By source: ``passed``, and figures such as ``ate_rmse_m``.
        flights: By vehicle: ``passed``, ``failed`` (sentences), and figures such as ``collisions``.
    """

    passed: bool | None
    estimators: dict[str, dict[str, Any]]
    flights: dict[str, dict[str, Any]] = {}


class ProcessSummary(msgspec.Struct, frozen=True):
    """A process of a run.

    Attributes:
        clock_offset_ms: Its monotonic clock, less that of the process whose summary this is.
        round_trip_ms: Of the quickest question and answer; the offset is off by half of it at most.
        clock_drift_ppm: How much quicker its clock is, in millionths, if ours follows it.
        waited: Most messages that waited for the network on their way there.
        replaced: Events that newer ones replaced on their way there.
    """

    nodes: list[str]
    place: str
    clock_offset_ms: float | None = None
    round_trip_ms: float | None = None
    clock_drift_ppm: float | None = None
    waited: int = 0
    replaced: int = 0


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a run.

    Attributes:
        clock: ``lockstep`` or ``real``.
        ended_by: A node's name, ``user``, or "" for its duration; see `RunEnd`.
        wall_seconds: Real seconds, from the first update to when the end was asked for.
        sim_seconds: The same time on the run's clock: all events were sent in it.
        digest: Fingerprint of all events in order; equal for equal runs in lockstep. (They
            compare on machines of one kind; see docs/explanation/determinism.md.) `None` if off.
        digests: Fingerprint of each output's events, of which that of the run is made.
        inputs_digest: Fingerprint of what estimators are fed: sensors, true poses, and their
            announcements (`runtime.run.summarise.inputs`). `None` if digests are off.
        inputs: Fingerprint of each output and announcement that counts to the inputs.
        not_deterministic: Nodes because of which equal runs may have unequal digests.
        truth_readers: Nodes that received true poses: estimators, and all others but those that
            fly, judge, record or show.
        environment: Machine and versions; the command line, and the commit of this project.
        code: Hash of each estimator's own files, by its node: its class with local imports, and the
            program of a `Process`; as they were when the run began.
        truth: What is otherwise than it was announced, as a camera's calibration, by subject.
        processes: Where which nodes ran, if not all in one process.
        workers: Costs of workers, by ``node.Factory``, and of programs, by their nodes.
        outside: Answers of systems outside the process, by name.
        twice: Comparison with an equal run before; `None` if there was none.
    """

    name: str
    clock: str
    seed: int
    reason: str
    ended_by: str
    error: str | None
    sim_seconds: float
    wall_seconds: float
    digest: str | None
    digests: dict[str, str]
    inputs_digest: str | None = None
    inputs: dict[str, str] = {}
    not_deterministic: list[str]
    verdict: Verdict | None
    events: dict[str, int]
    outputs: dict[str, int]
    drops: dict[str, int]
    streams: dict[str, StreamSummary]
    links: dict[str, LinkSummary]
    ticks: dict[str, TickSummary]
    stalls: dict[str, int]
    longest_stalls: dict[str, Stall]
    truth_readers: list[str]
    announcements: list[dict[str, Any]]
    environment: dict[str, str]
    code: dict[str, str] = {}
    truth: dict[str, dict[str, Any]] = {}
    processes: list[ProcessSummary] = []
    workers: dict[str, WorkerSummary] = {}
    outside: dict[str, OutsideSummary] = {}
    twice: TwiceSummary | None = None


def verdict_of(
    conclusions: dict[str, dict[str, Any]], flights: dict[str, dict[str, Any]]
) -> Verdict | None:
    """Return the joint verdict of several conclusions; `None` if there are none."""
    if not conclusions and not flights:
        return None
    return Verdict(overall(conclusions.values(), flights.values()), conclusions, flights)


def overall(
    conclusions: Iterable[Mapping[str, Any]], flights: Iterable[Mapping[str, Any]] = ()
) -> bool | None:
    """Return the joint result of verdicts: failed before not judged before passed.

    A flight of which nothing was asked counts only if there is no estimator.
    """
    states = {one["passed"] for one in conclusions}
    flown = {one["passed"] for one in flights}
    if False in states | flown:
        return False
    states = states or flown
    return None if None in states or not states else True


def merged(parts: list[Summary], processes: list[ProcessSummary]) -> Summary:
    """Merge the summaries of a run's processes; common entries are taken once."""
    first = parts[0]
    verdicts = [part.verdict for part in parts if part.verdict is not None]
    stalls: Counter[str] = Counter()
    events: Counter[str] = Counter()
    for part in parts:
        events.update(part.events)
        stalls.update(part.stalls)

    def of_all(field: str) -> dict[str, Any]:
        return {key: value for part in parts for key, value in getattr(part, field).items()}

    digests, inputs = of_all("digests"), of_all("inputs")
    fingerprinted = all(part.digest for part in parts)
    return msgspec.structs.replace(
        first,
        error=next((part.error for part in parts if part.error), None),
        sim_seconds=max(part.sim_seconds for part in parts),
        wall_seconds=max(part.wall_seconds for part in parts),
        digest=combined(digests) if fingerprinted else None,
        digests=dict(sorted(digests.items())),
        inputs_digest=combined(inputs) if fingerprinted else None,
        inputs=dict(sorted(inputs.items())),
        not_deterministic=sorted({node for part in parts for node in part.not_deterministic}),
        verdict=verdict_of(
            {k: f for v in verdicts for k, f in v.estimators.items()},
            {k: f for v in verdicts for k, f in v.flights.items()},
        ),
        events=dict(sorted(events.items())),
        stalls=dict(stalls),
        longest_stalls=of_all("longest_stalls"),
        truth_readers=sorted({node for part in parts for node in part.truth_readers}),
        processes=processes,
        **{
            field: of_all(field)
            for field in (
                "outputs",
                "drops",
                "streams",
                "links",
                "ticks",
                "code",
                "workers",
                "outside",
            )
        },
    )
