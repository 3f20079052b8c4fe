"""What a run reports of itself: ``summary.json`` and the table at its end."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import msgspec

from runtime.answers import Answers, Outcome, Wrong
from runtime.digest import Digest, combined
from runtime.json_values import plain
from runtime.node import matchers, senders, streams
from runtime.run_state import RunState
from runtime.schedule import SECOND
from runtime.watchdogs.loop import Stall
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
        empty: Frames with an answer that held nothing, such as no pose.
        initialising: Frames without an answer, from before the first one, as was allowed.
        skipped: Frames that the system left out, as a later answer says.
        lost: Frames for which none came in time.
        open: Frames on their way when the run ended.
        late: Answers to frames that were given up.
        repeated: Second answers to a frame.
        unknown: Answers whose stamp is no frame's.
        initialisation_s: From the first frame to the first that was answered.
        wall_p50_ms: Real time from a frame to its answer: median.
        wall_p99_ms: 99th percentile.
        inputs: Digest of all that the system was sent; equal if it got the same.
        reproducible: Whether an equal run gives the same, if the system answers the same.
        why_not: Why it may not.
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

    @classmethod
    def of(cls, answers: Answers) -> OutsideSummary:
        """Sum up what there is."""
        counts = {name: answers.counts[name] for name in (*get_args(Outcome), *get_args(Wrong))}
        p50, p99 = answers.latency_quantiles(0.5, 0.99)
        return cls(
            latency_ms=None if answers.latency is None else round(answers.latency * 1e3, 6),
            sent=answers.sent,
            received=answers.received,
            open=answers.sent - sum(counts[name] for name in get_args(Outcome)),
            initialisation_s=answers.initialisation,
            wall_p50_ms=None if p50 is None else p50 * 1e3,
            wall_p99_ms=None if p99 is None else p99 * 1e3,
            inputs=answers.inputs(),
            reproducible=not answers.why_not,
            why_not=list(answers.why_not),
            **counts,
        )

    def row(self) -> list[str]:
        """Return it as a table shows it, under `OUTSIDE_COLUMNS`."""
        return [
            *(f"{self.sent}", "–" if self.received is None else f"{self.received}"),
            *(str(each) for each in (self.answered, self.empty, self.initialising, self.skipped)),
            *(str(each) for each in (self.lost, self.late, self.repeated, self.unknown)),
            *(
                "–" if each is None else f"{each:.3g}"
                for each in (self.initialisation_s, self.latency_ms, self.wall_p50_ms)
            ),
            "yes" if self.reproducible else f"no: {'; '.join(self.why_not)}",
        ]


OUTSIDE_COLUMNS = (
    *("sent", "received", "answered", "empty", "initialising", "skipped"),
    *("lost", "late", "repeated", "of no frame"),
    *("initialised s", "latency ms", "real p50 ms", "reproducible"),
)


class Verdict(msgspec.Struct, frozen=True):
    """How those did whom the run was about.

    Attributes:
        passed: Whether all met their thresholds; `None` if none failed and one was not judged.
        estimators: By source: ``passed``, and figures such as ``ate_rmse_m``.
    """

    passed: bool | None
    estimators: dict[str, dict[str, Any]]


class ProcessSummary(msgspec.Struct, frozen=True):
    """One of the processes of a run.

    Attributes:
        nodes: That ran in it.
        place: Host and process number.
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
    """One run.

    Attributes:
        name: Of the run.
        clock: ``lockstep`` or ``real``.
        seed: Of the run's random numbers.
        reason: What ended it.
        error: What went wrong, or `None`.
        wall_seconds: Real seconds, from the first update to when the end was asked for.
        sim_seconds: The same time on the run's clock: what was sent, was sent in it.
        digest: Fingerprint of all events in order; equal for equal runs in lockstep. (Pixels
            depend on the graphics driver, so digests compare on one machine.) `None` if off.
        digests: Fingerprint of each output's events, of which that of the run is made.
        not_deterministic: Nodes because of which equal runs may have unequal digests.
        verdict: What nodes concluded; `None` if none did.
        events: Events sent, by type.
        outputs: Events sent, by output.
        drops: Events dropped, by input.
        streams: Inputs' bounds and peaks.
        links: What links did, by port.
        ticks: Punctuality, by ticker.
        stalls: Times the loop did not turn, by node.
        longest_stalls: The worst of them, by node.
        announcements: What nodes announced.
        environment: Machine and versions; the command line, and the commit of the current folder.
        processes: Where which nodes ran, if not all in one process.
        workers: What workers cost, by ``node.Factory``.
        outside: How systems outside the process answered, by name.
    """

    name: str
    clock: str
    seed: int
    reason: str
    error: str | None
    sim_seconds: float
    wall_seconds: float
    digest: str | None
    digests: dict[str, str]
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
    announcements: list[dict[str, Any]]
    environment: dict[str, str]
    processes: list[ProcessSummary] = []
    workers: dict[str, WorkerSummary] = {}
    outside: dict[str, OutsideSummary] = {}


def count_events(state: RunState) -> tuple[Counter[str], Counter[str]]:
    """Count what was sent so far, by type of event and by output."""
    by_type: Counter[str] = Counter()
    by_output: Counter[str] = Counter()
    for node in state.all_nodes:
        for sender in senders(node).values():
            for event, count in sender.sent().items():
                by_type[event.__name__] += count
                by_output[sender.name] += count
    return by_type, by_output


def count_drops(state: RunState) -> dict[str, StreamSummary]:
    """Return how full each input got and what it dropped."""
    found: dict[str, StreamSummary] = {}
    for node in state.all_nodes:
        missed = {port: matcher.missed for port, matcher in matchers(node).items()}
        for port, stream in streams(node).items():
            before = found.get(stream.name, StreamSummary(stream.bound, 0, 0))
            now = stream.statistics()
            found[stream.name] = StreamSummary(
                stream.bound,
                max(before.peak, now.peak),
                before.dropped + now.dropped,
                dict(Counter(before.missed) + Counter(missed.get(port, {}))),
            )
    return found


def tick_summaries(state: RunState) -> dict[str, TickSummary]:
    """Return how punctual each ticker was."""
    return {
        name: TickSummary(
            hz=ticker.hz,
            calls=ticker.calls,
            late_p50_us=ticker.late.quantile(0.5) / 1e3,
            late_p99_us=ticker.late.quantile(0.99) / 1e3,
            late_max_us=ticker.late.maximum / 1e3,
            missed=ticker.missed,
        )
        for name, ticker in state.tickers.items()
    }


def summarise(
    state: RunState,
    *,
    digest: Digest | None,
    stalls: Counter[str],
    longest_stalls: dict[str, Stall],
) -> Summary:
    """Put together what is known at the end of a run."""
    by_type, by_output = count_events(state)
    by_input = count_drops(state)
    ended = state.stopped or time.monotonic()
    return Summary(
        name=state.config.run.name,
        clock=state.clock.kind,
        seed=state.config.run.seed,
        reason=state.reason,
        error=None if state.error is None else str(state.error),
        sim_seconds=(state.clock.now() if state.stopped_at is None else state.stopped_at) / SECOND,
        wall_seconds=round(ended - (state.first_update or ended), 6),
        digest=digest.hexdigest() if digest else None,
        digests=digest.outputs() if digest else {},
        not_deterministic=_not_deterministic(state),
        verdict=_verdict(state.conclusions | _losses(state.outside)),
        events=dict(sorted(by_type.items())),
        outputs=dict(by_output),
        drops={port: s.dropped for port, s in by_input.items()},
        streams=by_input,
        links={link.name: LinkSummary(link.lost, link.thinned) for link in state.links.values()},
        ticks=tick_summaries(state),
        stalls=dict(stalls),
        longest_stalls=longest_stalls,
        announcements=[
            {"type": type(a).__name__, **plain(a, a.source)} for a in state.announcements
        ],
        environment={
            **environment(),
            **state.environment,
            "command": command_line(),
            "commit": commit(),
        },
        workers={name: WorkerSummary.of(each) for name, each in state.costs.items()},
        outside={name: OutsideSummary.of(each) for name, each in state.outside.items()},
    )


def _not_deterministic(state: RunState) -> list[str]:
    nodes = {node.name for node in state.all_nodes if not node.deterministic}
    held = state.outside.items() if state.clock.kind == "lockstep" else ()
    return sorted(nodes | {name for name, answers in held if answers.why_not})


def _losses(outside: dict[str, Answers]) -> dict[str, dict[str, Any]]:
    """Return a verdict on each system that has lost more frames than it may."""
    return {
        f"{name} (answers)": {
            "passed": False,
            "lost_frames": lost,
            "failed": [f"lost_frames: expected at most {most}, found {lost}"],
        }
        for name, answers in outside.items()
        if (lost := answers.counts["lost"]) > (most := answers.lost_allowed)
    }


def _verdict(found: dict[str, dict[str, Any]]) -> Verdict | None:
    if not found:
        return None
    return Verdict(overall(each["passed"] for each in found.values()), found)


def overall(passed: Iterable[bool | None]) -> bool | None:
    """Return what several verdicts are together: failed before not judged before passed."""
    each = set(passed)
    return False if False in each else None if None in each else True


def merged(parts: list[Summary], processes: list[ProcessSummary]) -> Summary:
    """Put together the summaries of one run's processes; where it runs together, once."""
    first = parts[0]
    digests = {name: each for part in parts for name, each in part.digests.items()}
    verdicts = [part.verdict for part in parts if part.verdict is not None]
    stalls: Counter[str] = Counter()
    events: Counter[str] = Counter()
    for part in parts:
        events.update(part.events)
        stalls.update(part.stalls)

    def of_all(field: str) -> dict[str, Any]:
        return {key: value for part in parts for key, value in getattr(part, field).items()}

    return msgspec.structs.replace(
        first,
        error=next((part.error for part in parts if part.error), None),
        sim_seconds=max(part.sim_seconds for part in parts),
        wall_seconds=max(part.wall_seconds for part in parts),
        digest=combined(digests) if all(part.digest for part in parts) else None,
        digests=dict(sorted(digests.items())),
        not_deterministic=sorted({node for part in parts for node in part.not_deterministic}),
        verdict=_verdict({k: f for v in verdicts for k, f in v.estimators.items()}),
        events=dict(sorted(events.items())),
        stalls=dict(stalls),
        longest_stalls=of_all("longest_stalls"),
        processes=processes,
        **{
            field: of_all(field)
            for field in ("outputs", "drops", "streams", "links", "ticks", "workers", "outside")
        },
    )


def environment() -> dict[str, str]:
    """Return what a figure depends on: machine, Python and the libraries' versions."""
    libraries = [
        "visnav-runtime",
        "numpy",
        "mujoco",
        "opencv-python-headless",
        "scipy",
        "uvloop",
        "msgspec",
    ]
    versions = {}
    for library in libraries:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            versions[library] = "not installed"
    return {
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "processor": platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        **versions,
    }


_SECRET = re.compile(r"(secret\s*=\s*)(?!\W*(?:file|env):).*", re.DOTALL)
"""A secret in a setting of the command line, unless it only says where the secret is."""


def command_line() -> str:
    """Return the command that started this process, without Python's folder and secrets."""
    program, *arguments = sys.orig_argv
    shown = [_SECRET.sub(r"\1…", each) for each in arguments]
    return shlex.join([Path(program).name, *shown])


def commit(folder: Path | None = None) -> str:
    """Return the commit of a folder's files, with ``-dirty`` if they differ; empty without git.

    Args:
        folder: Somewhere in a repository; the current folder if not given.
    """
    command = ["git", "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(  # noqa: S603
            command, cwd=folder, capture_output=True, text=True, check=True, timeout=5.0
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
